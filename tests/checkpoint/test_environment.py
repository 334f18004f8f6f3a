"""An environment resumes bit for bit from the state of another one."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.envs.classic_control import CartPoleEnv
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import (
    CatFrames,
    Compose,
    DoubleToFloat,
    EnvBase,
    GymEnv,
    GymWrapper,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    UnsqueezeTransform,
    VecNormV2,
)

import torchrl_tit.tasks  # noqa: F401  # registers TMaze-v0
from torchrl_tit.checkpoint import (
    can_save_env,
    env_state,
    load_checkpoint,
    save_checkpoint,
    set_env_state,
)
from torchrl_tit.envs import make_env

CLASSIC = {
    # A limit that is no divisor of the number of steps, so that time limits fall on both sides.
    "CartPole-v1": 23,
    "Acrobot-v1": 17,
    "MountainCar-v0": 19,
    "MountainCarContinuous-v0": 19,
    "Pendulum-v1": 13,
}
MUJOCO = [f"{name}-v5" for name in ("HalfCheetah", "Hopper", "Walker2d", "Ant")]
OTHER_MUJOCO = [
    *(f"{name}-v4" for name in ("HalfCheetah", "Hopper", "Walker2d", "Ant")),
    *(f"{name}-v5" for name in ("Humanoid", "HumanoidStandup", "InvertedDoublePendulum")),
    *(f"{name}-v5" for name in ("InvertedPendulum", "Pusher", "Reacher", "Swimmer")),
    *("Humanoid-v4", "Reacher-v4"),
]


def make_vector(
    name: str,
    num_envs: int,
    wrappers: tuple[Callable[[gym.Env], gym.Wrapper], ...] = (),
    **kwargs: Any,
) -> EnvBase:
    vector = gym.make_vec(
        name,
        num_envs,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP},
        wrappers=wrappers,
        **kwargs,
    )
    return TransformedEnv(
        GymWrapper(vector, categorical_action_encoding=True),
        Compose(
            DoubleToFloat(),
            UnsqueezeTransform(dim=-2, in_keys=["observation"], out_keys=["history"]),
            CatFrames(N=4, dim=-2, in_keys=["history"], padding="constant"),
            StepCounter(),
            RewardSum(),
        ),
    )


def make_single(name: str, **kwargs: Any) -> EnvBase:
    return TransformedEnv(
        GymEnv(name, categorical_action_encoding=True, **kwargs),
        Compose(
            UnsqueezeTransform(dim=-2, in_keys=["observation"], out_keys=["history"]),
            CatFrames(N=3, dim=-2, in_keys=["history"]),
            StepCounter(),
        ),
    )


def random_actions(env: EnvBase, steps: int) -> list[torch.Tensor]:
    torch.manual_seed(0)
    return [env.action_spec.rand() for _ in range(steps)]


def walk(
    env: EnvBase, carried: TensorDictBase, actions: list[torch.Tensor]
) -> tuple[TensorDictBase, TensorDictBase]:
    steps = []
    for action in actions:
        step, carried = env.step_and_maybe_reset(carried.set("action", action))
        steps.append(step.clone())
    return torch.stack(steps) if steps else carried.empty(), carried


def assert_bit_equal(left: TensorDictBase, right: TensorDictBase) -> None:
    keys = set(left.keys(True, True))
    assert keys == set(right.keys(True, True))
    for key in keys:
        assert left[key].dtype == right[key].dtype
        assert left[key].equal(right[key]), key


def check_continues(
    tmp_path: Path, make: Callable[[], EnvBase], before: int, after: int, reset_first: bool = False
) -> TensorDictBase:
    env = make()
    env.set_seed(3)
    actions = random_actions(env, before + after)
    _, carried = walk(env, env.reset(), actions[:before])
    save_checkpoint(tmp_path, before, {"env": env_state(env), "carried": carried.clone()})
    expected, _ = walk(env, carried, actions[before:])

    other = make()
    if reset_first:
        other.set_seed(4)
        walk(other, other.reset(), random_actions(other, 7))
    _, state = load_checkpoint(tmp_path)
    set_env_state(other, state["env"])
    got, _ = walk(other, state["carried"], actions[before:])
    assert_bit_equal(got, expected)
    return expected


@pytest.mark.parametrize("reset_first", [False, True], ids=["new", "used"])
@pytest.mark.parametrize("name", CLASSIC)
def test_classic_control_vector(tmp_path: Path, name: str, reset_first: bool) -> None:
    def make() -> EnvBase:
        return make_vector(name, 3, max_episode_steps=CLASSIC[name])

    steps = check_continues(tmp_path, make, before=50, after=60, reset_first=reset_first)
    assert steps["next", "done"].sum() >= 6  # new episodes were drawn on the way
    assert steps["next", "truncated"].any()


@pytest.mark.parametrize("reset_first", [False, True], ids=["new", "used"])
def test_t_maze_vector(tmp_path: Path, reset_first: bool) -> None:
    # So short that random actions reach the goal: its side is part of the state.
    steps = check_continues(
        tmp_path,
        lambda: make_vector("TMaze-v0", 8, corridor_length=1),
        before=51,
        after=60,
        reset_first=reset_first,
    )
    assert (steps["next", "reward"] == 1).any()


@pytest.mark.parametrize("name", MUJOCO)
def test_mujoco_vector(tmp_path: Path, name: str) -> None:
    steps = check_continues(
        tmp_path, lambda: make_vector(name, 2, max_episode_steps=31), before=50, after=45
    )
    assert steps["next", "done"].any()
    assert steps["next", "reward"].unique().numel() > 50


@pytest.mark.parametrize("reset_first", [False, True], ids=["new", "used"])
@pytest.mark.parametrize(
    "name", ["CartPole-v1", "Pendulum-v1", "Ant-v5", "Blackjack-v1", "FrozenLake-v1", "Taxi-v4"]
)
def test_our_own_vector(tmp_path: Path, name: str, reset_first: bool) -> None:
    def make() -> EnvBase:
        env = make_env(name, 3, num_frames=4, padding="constant", max_episode_steps=13)
        return TransformedEnv(env, StepCounter())

    steps = check_continues(tmp_path, make, before=20, after=30, reset_first=reset_first)
    assert steps["next", "done"].sum() >= 6


@pytest.mark.parametrize("name", OTHER_MUJOCO)
@pytest.mark.filterwarnings("ignore:.*out of date")
def test_other_mujoco(tmp_path: Path, name: str) -> None:
    check_continues(tmp_path, lambda: make_single(name), before=5, after=10)


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1", "Ant-v5"])
@pytest.mark.parametrize("before", [0, 1, 2, 20])
def test_single_and_the_first_steps(tmp_path: Path, name: str, before: int) -> None:
    # Gymnasium's checker watches the first steps, and the history is still being filled.
    check_continues(tmp_path, lambda: make_single(name), before=before, after=10)


def test_at_the_very_end_of_an_episode(tmp_path: Path) -> None:
    """Between a step that ends episodes and the reset that TorchRL makes of it."""
    make = lambda: make_vector("CartPole-v1", 3, max_episode_steps=9)  # noqa: E731
    env, other = make(), make()
    env.set_seed(0)
    carried = env.reset()
    done = torch.tensor(False)
    while not done.any() or done.all():
        step = env.step(carried.set("action", env.action_spec.rand()))
        done = step["next", "done"]
        if not done.any() or done.all():
            carried = env.maybe_reset(env.step_mdp(step))
    save_checkpoint(tmp_path, 1, {"env": env_state(env), "step": step.clone()})
    _, state = load_checkpoint(tmp_path)
    set_env_state(other, state["env"])
    expected = env.maybe_reset(env.step_mdp(step))
    got = other.maybe_reset(other.step_mdp(state["step"]))
    assert_bit_equal(got, expected)


def test_before_the_first_reset() -> None:
    # The generators are made by the time they are saved, so both runs draw the same.
    env, other = make_single("Pendulum-v1"), make_single("Pendulum-v1")
    set_env_state(other, env_state(env))
    assert_bit_equal(env.reset(), other.reset())


def test_wrappers_that_count(tmp_path: Path) -> None:
    def make() -> EnvBase:
        return make_vector(
            "Pendulum-v1",
            2,
            wrappers=(
                gym.wrappers.RecordEpisodeStatistics,
                lambda env: gym.wrappers.RescaleAction(env, np.float32(-1), np.float32(1)),
                gym.wrappers.ClipAction,
            ),
            max_episode_steps=8,
        )

    def counter(env: EnvBase) -> gym.wrappers.RecordEpisodeStatistics:
        return env.base_env._env.envs[0].env.env

    env, other = make(), make()
    env.set_seed(0)
    walk(env, env.reset(), random_actions(env, 20))
    save_checkpoint(tmp_path, 20, env_state(env))
    set_env_state(other, load_checkpoint(tmp_path)[1])
    assert counter(other).episode_count == counter(env).episode_count == 2
    assert counter(other).episode_lengths == 4
    assert counter(other).return_queue == counter(env).return_queue
    assert counter(other).return_queue.maxlen == 100


def test_generators_of_spaces() -> None:
    env, other = make_vector("CartPole-v1", 2), make_vector("CartPole-v1", 2)
    for vector in (env.base_env._env, other.base_env._env):
        vector.reset(seed=0)
    env.base_env._env.action_space.seed(5)
    env.base_env._env.envs[1].unwrapped.observation_space.seed(6)
    env.base_env._env.observation_space._np_random = None  # not seeded
    set_env_state(other, env_state(env))
    for pick in (
        lambda env: env.base_env._env.action_space,
        lambda env: env.base_env._env.envs[1].unwrapped.observation_space,
    ):
        assert (pick(env).sample() == pick(other).sample()).all()
    assert other.base_env._env.observation_space._np_random is None


def test_transforms_that_learn(tmp_path: Path) -> None:
    def make() -> EnvBase:
        return TransformedEnv(make_vector("Pendulum-v1", 2), VecNormV2(in_keys=["observation"]))

    check_continues(tmp_path, make, before=10, after=10)


def test_uint8_history_in_a_new_environment() -> None:
    # A new environment's buffer does not know yet that frames are bytes.
    frames = CatFrames(N=2, dim=-3, in_keys=["pixels"])
    env = TransformedEnv(GymEnv("CartPole-v1"), Compose(frames))
    buffer = torch.randint(0, 255, (2, 3, 3), dtype=torch.uint8)
    frames._call(TensorDict({"pixels": buffer[:1]}))
    state = env_state(env)
    other_frames = CatFrames(N=2, dim=-3, in_keys=["pixels"])
    other = TransformedEnv(GymEnv("CartPole-v1"), Compose(other_frames))
    set_env_state(other, state)
    got, expected = (
        each._call(TensorDict({"pixels": buffer[1:]}))["pixels"] for each in (other_frames, frames)
    )
    assert got.dtype == torch.uint8
    assert got.equal(expected)
    assert got.equal(buffer)


def test_state_is_a_snapshot() -> None:
    env = make_vector("Pendulum-v1", 2)
    env.set_seed(0)
    _, carried = walk(env, env.reset(), random_actions(env, 5))
    state, saved = env_state(env), carried.clone()
    expected, _ = walk(env, carried, random_actions(env, 5))
    for _ in range(2):  # neither walking on nor restoring changes it
        set_env_state(env, state)
        got, _ = walk(env, saved.clone(), random_actions(env, 5))
        assert_bit_equal(got, expected)


class Pole(CartPoleEnv):
    """A subclass may remember more than its parent."""


def test_environments_that_cannot_be_saved() -> None:
    unknown = {
        "Pole": GymWrapper(Pole()),
        "FrameStackObservation": GymWrapper(
            gym.wrappers.FrameStackObservation(gym.make("CartPole-v1"), 2)
        ),
        "SerialEnv": SerialEnv(2, lambda: GymEnv("CartPole-v1")),
        "AsyncVectorEnv": GymWrapper(
            gym.make_vec(
                "CartPole-v1",
                2,
                vectorization_mode="async",
                vector_kwargs={"autoreset_mode": gym.vector.AutoresetMode.SAME_STEP},
            )
        ),
    }
    for name, env in unknown.items():
        assert not can_save_env(env)
        with pytest.raises(TypeError, match=f"{name} in it cannot be saved; reset it"):
            env_state(env)
        with pytest.raises(TypeError, match=name):
            set_env_state(env, {})
        assert not can_save_env(TransformedEnv(env, StepCounter()))


def test_state_of_another_environment() -> None:
    state = env_state(make_vector("CartPole-v1", 2))
    for other in (make_vector("CartPole-v1", 3), make_vector("Acrobot-v1", 2)):
        with pytest.raises(ValueError, match="use the settings of the saved environment"):
            set_env_state(other, state)
    plain = GymEnv("CartPole-v1")
    with pytest.raises(ValueError, match="levels of transforms"):
        set_env_state(plain, env_state(TransformedEnv(GymEnv("CartPole-v1"), StepCounter())))
    framed = TransformedEnv(GymEnv("CartPole-v1"), CatFrames(N=2, dim=-1, in_keys=["observation"]))
    with pytest.raises(ValueError, match="_cat_buffers_observation"):
        set_env_state(framed, env_state(TransformedEnv(GymEnv("CartPole-v1"), StepCounter())))
