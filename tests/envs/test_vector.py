"""GymVectorEnv does what TorchRL's wrapper does, and keeps TorchRL's contract."""

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict import assert_close
from torchrl.collectors import Collector
from torchrl.data import Unbounded
from torchrl.envs.utils import check_env_specs
from torchrl.modules import RandomPolicy

from tests.envs.reference import wrapped
from torchrl_tit.envs import GymVectorEnv, make_env

WRITTEN = ("observation", "history", "episode_reward", "reward", "terminated", "truncated", "done")


def vector(mode=AutoresetMode.DISABLED):
    tasks = [lambda: gymnasium.make("CartPole-v1")] * 3
    return GymVectorEnv(SyncVectorEnv(tasks, autoreset_mode=mode))


def actions(env, seed=0):
    """An endless stream of actions, the same for the same seed."""
    generator = torch.Generator().manual_seed(seed)
    spec = env.action_spec
    while True:
        if spec.dtype.is_floating_point:
            yield torch.randn(spec.shape, generator=generator)
        else:
            yield torch.randint(0, int(spec.space.n), spec.shape, generator=generator)


def play(env, steps):
    """Returns each step and what came next."""
    root, chosen, written = env.reset(), actions(env), []
    for _ in range(steps):
        step, root = env.step_and_maybe_reset(root.set("action", next(chosen)))
        written.append((step.clone(), root.clone()))
    return written


@pytest.mark.parametrize(
    ("name", "limit", "num_envs", "num_frames", "padding"),
    [
        ("CartPole-v1", 500, 3, 4, "same"),
        ("CartPole-v1", 7, 1, 1, "same"),
        ("Hopper-v5", 12, 3, 1, "same"),
        ("Hopper-v5", 12, 1, 4, "constant"),
    ],
)
def test_equals_gym_wrapper_and_transforms(name, limit, num_envs, num_frames, padding):
    settings = {"max_episode_steps": limit}
    ours = make_env(
        name,
        num_envs,
        seed=3,
        num_frames=num_frames,
        padding=padding,
        clip_actions=False,
        **settings,
    )
    theirs = wrapped(name, num_envs, 3, num_frames, padding, **settings)
    ended = 0
    for (step, root), (expected_step, expected_root) in zip(
        play(ours, 80), play(theirs, 80), strict=True
    ):
        ended += int(step["next", "done"].sum())
        entries = [key for key in WRITTEN if key != "reward"]
        assert_close(step["next"].select(*WRITTEN), expected_step["next"].select(*WRITTEN), 0, 0)
        assert_close(root.select(*entries), expected_root.select(*entries), 0, 0)
    assert ended > num_envs


@pytest.mark.parametrize("num_frames", [1, 3])
def test_a_partial_reset_keeps_the_others(num_frames):
    env = make_env("CartPole-v1", 3, seed=0, num_frames=num_frames)
    before = play(env, 5)[-1][1]
    request = before.clone().set("_reset", torch.tensor([[False], [True], [False]]))
    after = env.reset(request)
    for key in ("observation", "history", "episode_reward"):
        assert torch.equal(after[key][[0, 2]], before[key][[0, 2]])
        assert not torch.equal(after[key][1], before[key][1])


def test_actions_are_clipped_on_their_way_only():
    env = make_env("Pendulum-v1", 1, clip_actions=True)
    root = env.reset(seed=0).set("action", torch.full((1, 1), 7.0))
    step, _ = env.step_and_maybe_reset(root)
    task = gymnasium.make("Pendulum-v1")
    task.reset(seed=0)
    observation, reward, *_ = task.step(np.array([2.0], np.float32))
    assert step["action"].item() == 7.0
    np.testing.assert_array_equal(step["next", "observation"][0], observation)
    assert step["next", "reward"].item() == pytest.approx(float(reward))
    assert isinstance(env.action_spec, Unbounded)


def test_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match=r"autoreset_mode=AutoresetMode.DISABLED, not .*SAME_STEP"):
        vector(mode=AutoresetMode.SAME_STEP)
    env = vector()
    root = env.rand_action(env.reset())
    root.set("_step", torch.tensor([True, False, True]))
    with pytest.raises(NotImplementedError, match="only some of its environments"):
        env.step(root)
    root.set("_step", torch.ones(3, dtype=torch.bool))
    assert env.step(root)["next", "observation"].shape == (3, 4)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu():
    ours, expected = (
        make_env("Pendulum-v1", 3, seed=0, num_frames=3, max_episode_steps=9, device=device)
        for device in ("cuda", None)
    )
    check_env_specs(ours)
    ours.set_seed(0)
    for (step, root), (expected_step, expected_root) in zip(
        play(ours, 30), play(expected, 30), strict=True
    ):
        assert step["next", "history"].is_cuda
        assert_close(step.cpu(), expected_step, 0, 1e-6)
        assert_close(root.cpu(), expected_root, 0, 1e-6)


def test_steps_that_were_taken_can_lack_their_histories():
    """What comes next has them."""
    plain, lean = (
        make_env("Pendulum-v1", 3, seed=0, num_frames=3, keep_histories=keep)
        for keep in (True, False)
    )
    for (step, root), (expected_step, expected_root) in zip(
        play(lean, 210), play(plain, 210), strict=True
    ):
        assert_close(step, expected_step.exclude("history", ("next", "history")), 0, 0)
        assert_close(root, expected_root, 0, 0)
        assert "history" in root
    assert lean.rollout(5, break_when_any_done=False).shape == (3, 5)
    check_env_specs(lean)


def test_a_collector_stores_no_zeros_for_histories_that_steps_lack():
    """With its default arguments, which allocate a buffer for all entries of the specs."""
    env = make_env("CartPole-v1", 3, num_frames=4, keep_histories=False)
    [batch] = Collector(env, RandomPolicy(env.action_spec), frames_per_batch=60, total_frames=60)
    assert not {"history", ("next", "history")} & set(batch.keys(True))
    assert batch["observation"].any()


def test_what_spaces_draw_follows_from_the_seed():
    """In wrappers too, which draw actions from them, and again after each reset with a seed."""
    drawn = []
    for _ in range(2):
        env = GymVectorEnv(
            SyncVectorEnv(
                [lambda: gymnasium.wrappers.StickyAction(gymnasium.make("CartPole-v1"), 0.5)] * 2,
                autoreset_mode=AutoresetMode.DISABLED,
            )
        )
        env.set_seed(3)
        copies: Any = env._env
        first, second = copies.envs
        drawn.append([first.action_space.sample() for _ in range(20)])
        drawn.append([second.unwrapped.action_space.sample() for _ in range(20)])
        env.reset(seed=3)
        assert [first.action_space.sample() for _ in range(20)] == drawn[-2]
    assert drawn[:2] == drawn[2:]
    assert drawn[0] != drawn[1]
