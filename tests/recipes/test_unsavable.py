"""A run resumes bit for bit also where the environment cannot be saved."""

from dataclasses import replace

import pytest
import torch

from recipes import runner
from recipes.ppo import PPO
from recipes.run import Run
from torchrl_tit.envs import make_env
from torchrl_tit.settings.networks import mlp, nature_cnn


def weights(recipe, folder):
    """Trains in a run folder, new or not, and returns what was learnt."""
    with Run(folder, recipe) as run:
        runner.train(recipe, run)
        loaded = run.load()
    assert loaded is not None
    return loaded[1]["networks"]


@pytest.mark.parametrize(
    ("mode", "env", "backbone"),
    [
        ("async", "CartPole-v1", mlp()),
        ("sync", "ALE/Breakout-v5", nature_cnn()),
    ],
)
def test_resumes_bit_for_bit(tmp_path, mode, env, backbone):
    if env.startswith("ALE/"):
        pytest.importorskip("ale_py")
    recipe = PPO(
        env=env,
        backbone=backbone,
        num_envs=2,
        vectorization_mode=mode,
        total_steps=96,
        steps_per_batch=32,
        minibatch_size=16,
        epochs=1,
        checkpoint_interval=32,
        evaluation_episodes=1,
    )
    for name in ("whole", "stopped"):
        (tmp_path / name).mkdir()
    expected = weights(recipe, tmp_path / "whole")
    early = weights(replace(recipe, total_steps=32), tmp_path / "stopped")
    late = weights(recipe, tmp_path / "stopped")
    assert any(not torch.equal(early[key], late[key]) for key in late)
    assert all(torch.equal(expected[key], late[key]) for key in expected)


def test_processes_have_the_numbers_of_one():
    envs = [
        make_env("CartPole-v1", 3, seed=0, num_frames=2, vectorization_mode=mode)
        for mode in ("sync", "async")
    ]
    roots = [env.reset() for env in envs]
    ended = 0
    torch.manual_seed(0)
    for _ in range(60):
        action = envs[0].rand_action(roots[0])["action"]
        steps = [
            env.step_and_maybe_reset(root.set("action", action))
            for env, root in zip(envs, roots, strict=True)
        ]
        (first, _), (second, _) = steps
        assert (first == second).all()
        roots = [root for _, root in steps]
        ended += int(first["next", "done"].sum())
    assert ended > 3
    for env in envs:
        env.close()
