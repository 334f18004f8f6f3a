"""GymVectorEnv does what TorchRL's wrapper does, and keeps TorchRL's contract."""

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from tensordict import TensorDict, assert_close
from torchrl.collectors import Collector
from torchrl.data import Unbounded
from torchrl.envs import EnvBase, StepCounter, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from tests.envs.reference import ImageTask, wrapped
from tests.transforms.streams import assert_histories
from torchrl_tit.envs import GymVectorEnv, make_env
from torchrl_tit.transforms import History

gymnasium.register("Image-v0", lambda **kwargs: ImageTask(**kwargs))

WRITTEN = (
    "observation",
    "history",
    "episode_reward",
    "reward",
    "terminated",
    "truncated",
    "done",
)


def vector(task=ImageTask, num_envs=3, mode=AutoresetMode.DISABLED, **kwargs):
    return GymVectorEnv(SyncVectorEnv([task] * num_envs, autoreset_mode=mode), **kwargs)


def actions(env, seed=0):
    """An endless stream of actions, the same for the same seed."""
    generator = torch.Generator().manual_seed(seed)
    spec = env.action_spec
    while True:
        if spec.dtype.is_floating_point:
            yield torch.randn(spec.shape, generator=generator)
        else:
            yield torch.randint(0, int(spec.space.n), spec.shape, generator=generator)


def play(env, steps, step=None, extra=None):
    """Returns each step and what came next."""
    step = step or env.step_and_maybe_reset
    root, chosen, written = env.reset(), actions(env), []
    for _ in range(steps):
        root.set("action", next(chosen))
        if extra is not None:
            root.set("extra", extra)
        done_step, root = step(root)
        written.append((done_step.clone(), root.clone()))
    return written


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("num_frames", [1, 4])
@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize(
    ("name", "limit"), [("CartPole-v1", 500), ("CartPole-v1", 7), ("Hopper-v5", 12)]
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


@pytest.mark.parametrize("top", [lambda env: env, lambda env: env.append_transform(StepCounter())])
def test_short_cut_equals_the_general_way(top):
    short, general = (top(make_env("CartPole-v1", 3, seed=0, num_frames=3)) for _ in range(2))
    extra = torch.arange(3)
    for (step, root), (expected_step, expected_root) in zip(
        play(short, 60, extra=extra),
        play(general, 60, lambda root: EnvBase.step_and_maybe_reset(general, root), extra),
        strict=True,
    ):
        assert set(step.keys(True, True)) == set(expected_step.keys(True, True))
        assert set(root.keys(True, True)) == set(expected_root.keys(True, True))
        assert_close(step, expected_step, 0, 0)
        assert_close(root, expected_root, 0, 0)
        assert root.get("extra") is not None


class Third(Transform):
    """Sends a third of the policy's action to the task."""

    def __init__(self):
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])

    def _inv_apply_transform(self, action):
        return action / 3


def test_transforms_with_an_inverse():
    env = make_env("Pendulum-v1", 2, seed=0, clip_actions=False).append_transform(Third())
    expected = make_env("Pendulum-v1", 2, seed=0, clip_actions=False)
    root, expected_root = env.reset(), expected.reset()
    for _ in range(5):
        action = torch.rand(2, 1)
        step, root = env.step_and_maybe_reset(root.set("action", 3 * action))
        other, expected_root = expected.step_and_maybe_reset(expected_root.set("action", action))
        assert torch.equal(step["action"], 3 * action)
        torch.testing.assert_close(step["next", "observation"], other["next", "observation"])


def test_keeps_what_the_policy_wrote_under_next():
    env = make_env("CartPole-v1", 2, seed=0)
    root = env.rand_action(env.reset())
    root["next", "memory"] = torch.ones(2, 5)
    step, _ = env.step_and_maybe_reset(root)
    assert torch.equal(step["next", "memory"], torch.ones(2, 5))
    assert step["next", "reward"].shape == (2, 1)


@pytest.mark.parametrize("num_frames", [1, 3])
def test_a_partial_reset_keeps_the_others(num_frames):
    env = make_env("CartPole-v1", 3, seed=0, num_frames=num_frames)
    before = play(env, 5)[-1][1]
    request = before.clone().set("_reset", torch.tensor([[False], [True], [False]]))
    after = env.reset(request)
    for key in ("observation", "history", "episode_reward"):
        assert torch.equal(after[key][[0, 2]], before[key][[0, 2]])
        assert not torch.equal(after[key][1], before[key][1])


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("num_frames", [1, 2, 8])
@pytest.mark.parametrize(
    ("name", "hide"), [("CartPole-v1", False), ("CartPole-v1", True), ("Image-v0", False)]
)
def test_histories_come_from_the_transform_alone(name, hide, num_frames, padding):
    env = make_env(name, 3, seed=0, num_frames=num_frames, padding=padding, hide_velocities=hide)
    written = {"observation", "reward", "terminated", "truncated", "done"}
    assert isinstance(env.base_env, GymVectorEnv)
    assert set(env.base_env.rollout(2)["next"].keys()) == written
    assert sum(isinstance(transform, History) for transform in env.transform) == 1
    torch.manual_seed(0)
    assert_histories(env, num_frames, padding)
    check_env_specs(env)
    keys = {*written, "action", "history", "episode_reward"} - {"reward"}
    assert set(env.rand_action(env.reset()).keys()) == keys


@pytest.mark.parametrize("name", ["CartPole-v1", "Image-v0"])
def test_returns_of_each_episode(name):
    env = make_env(name, 3, seed=0)
    returns = torch.zeros(3, 1)
    for step, root in play(env, 60):
        assert torch.equal(step["episode_reward"], returns)
        returns = returns + step["next", "reward"]
        assert torch.equal(step["next", "episode_reward"], returns)
        returns = returns * ~step["next", "done"]
        assert torch.equal(root["episode_reward"], returns)


def test_transforms_on_top_see_the_same():
    bare = make_env("CartPole-v1", 3, seed=0, num_frames=3)
    topped = TransformedEnv(make_env("CartPole-v1", 3, seed=0, num_frames=3), StepCounter())
    assert isinstance(topped.base_env, TransformedEnv)
    for (_, root), (_, expected) in zip(play(bare, 60), play(topped, 60), strict=True):
        assert_close(root.select(*WRITTEN[:3], "done"), expected.select(*WRITTEN[:3], "done"), 0, 0)


def test_collector_cuts_whole_rollouts():
    env = make_env("CartPole-v1", 2, seed=0, num_frames=2)
    collector = Collector(
        env, frames_per_batch=80, total_frames=160, track_traj_ids=False, policy=env.rand_action
    )
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    rollout = TensorDict.cat(batches, 1)
    assert rollout["history"].shape == (2, 80, 2, 4)
    going = ~rollout["next", "done"][:, :-1, 0]
    for key in ("observation", "history", "episode_reward"):
        assert torch.equal(rollout[key][:, 1:][going], rollout["next", key][:, :-1][going])
    assert not rollout["episode_reward"][:, 1:][~going].any()


def test_images_stay_uint8():
    env = vector()
    check_env_specs(env)
    assert env.reset()["observation"].dtype is torch.uint8
    assert env.observation_spec["observation"].shape == (3, 2, 4, 5)


def test_what_was_written_is_never_written_again():
    env = make_env("CartPole-v1", 2, seed=0, num_frames=3)
    root, kept = env.reset(), []
    for _ in range(30):
        step, root = env.step_and_maybe_reset(env.rand_action(root))
        kept.append((step, step.clone()))
    for written, copy in kept:
        assert_close(written, copy, 0, 0)


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


def test_a_policy_that_writes_no_action_is_named():
    with pytest.raises(KeyError, match="action"):
        make_env("CartPole-v1").rollout(1, lambda tensordict: tensordict, auto_reset=True)


def test_actions_have_bounds_where_they_are_not_clipped():
    space = make_env("Pendulum-v1", 3, clip_actions=False).action_spec.space
    assert torch.equal(space.low, torch.full((3, 1), -2.0))
    assert torch.equal(space.high, torch.full((3, 1), 2.0))


def test_a_time_limit_truncates_and_does_not_terminate():
    env = make_env("Pendulum-v1", 2, max_episode_steps=5)
    last = env.rollout(5)["next"][:, -1]
    assert last["truncated"].all()
    assert last["done"].all()
    assert not last["terminated"].any()


def test_a_fall_terminates_and_does_not_truncate():
    env = make_env("CartPole-v1", 1, seed=0)
    last = env.rollout(500)["next"][:, -1]
    assert last["terminated"].all()
    assert not last["truncated"].any()


def test_state_dict_holds_the_histories():
    env = make_env("CartPole-v1", 2, seed=0, num_frames=3)
    last = play(env, 5)[-1][1]
    other = make_env("CartPole-v1", 2, seed=1, num_frames=3)
    other.load_state_dict(env.state_dict())
    (saved,) = other.state_dict().values()
    assert torch.equal(saved, last["history"])


def test_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match=r"autoreset_mode=AutoresetMode.DISABLED, not .*SAME_STEP"):
        vector(mode=AutoresetMode.SAME_STEP)
    with pytest.raises(ValueError, match="num_frames must be at least 1, not 0"):
        make_env("CartPole-v1", num_frames=0)
    with pytest.raises(ValueError, match="field 'padding' is 'zeros', not one of"):
        make_env("CartPole-v1", padding="zeros")  # type: ignore[arg-type]
    env = vector()
    root = env.rand_action(env.reset())
    root.set("_step", torch.tensor([True, False, True]))
    with pytest.raises(NotImplementedError, match="only some of its environments"):
        env.step(root)
    root.set("_step", torch.ones(3, dtype=torch.bool))
    assert env.step(root)["next", "observation"].shape == (3, 2, 4, 5)


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


@pytest.mark.parametrize("top", [lambda env: env, lambda env: env.append_transform(Third())])
def test_steps_that_were_taken_can_lack_their_histories(top):
    """On the short cut and the general way; what comes next has them."""
    plain, lean = (
        top(make_env("Pendulum-v1", 3, seed=0, num_frames=3, keep_histories=keep))
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
