"""Tasks without their velocities: the networks compared on them."""

from dataclasses import replace

import pytest
from gymnasium.vector import AsyncVectorEnv

from recipes.core.algorithm import make_algorithm
from recipes.core.registry import RECIPES
from recipes.core.run import Run
from recipes.core.runner import evaluate, train
from tests.recipes.ppo.algorithms import named
from torchrl_tit.checkpoint import load_checkpoint
from torchrl_tit.settings import StackedInner


@pytest.mark.parametrize("name", [name for name in RECIPES if "-no-velocity/" in name])
def test_recipes_can_be_built_and_hide_the_velocities(name):
    recipe = named(name)
    algorithm = make_algorithm(recipe)
    algorithm.check()
    network = name.rpartition("/")[2]
    assert recipe.backbone.num_frames == (8 if "8" in network else 1)
    backbone = recipe.backbone
    positions = "learned" if network == "enhanced-tit-k8" else "none"
    assert getattr(backbone.history, "temporal_positions", "none") == positions
    assert isinstance(backbone.history, StackedInner) == ("wo-outer" in network)
    entries = {"CartPole-v1": 2, "Acrobot-v1": 4, "Hopper-v5": 5}[recipe.env]
    env = algorithm.make_env(2, seed=0)
    assert env.reset()["history"].shape == (2, backbone.num_frames, entries)


def test_a_run_in_processes_is_the_run_in_one(tmp_path, monkeypatch):
    recipe = replace(
        named("ppo/cartpole-no-velocity/mlp-stack-8"),
        num_envs=2,
        steps_per_batch=32,
        total_steps=64,
        minibatch_size=16,
        epochs=1,
        evaluation_episodes=3,
    )
    results, made = [], []

    class Processes(AsyncVectorEnv):
        def __init__(self, *arguments, **options):
            made.append(recipe.vectorization_mode)
            super().__init__(*arguments, **options)

    monkeypatch.setattr("torchrl_tit.envs.gymnasium_tasks.AsyncVectorEnv", Processes)
    for mode in ("sync", "async"):
        recipe = replace(recipe, vectorization_mode=mode)
        with Run.create(tmp_path / mode, recipe) as run:
            train(recipe, run)
            evaluation = evaluate(run)
        results.append((load_checkpoint(run.checkpoints)[1]["networks"], evaluation["returns"]))
    assert made == ["async"]
    (sync, returns), (async_, async_returns) = results
    assert returns == async_returns
    for name, weight in sync.items():
        assert (weight == async_[name]).all()
