"""What TorchRL's suite asks of each of its transforms (`TransformBase`), asked of ours."""

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDictBase, assert_close
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.envs import (
    Compose,
    EnvBase,
    GymEnv,
    ParallelEnv,
    SerialEnv,
    TargetReturn,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from torchrl_tit.transforms import HideVelocities, History, SequenceHistory

ONLINE: dict[str, Callable[[], Transform]] = {
    "History": lambda: History(3),
    "HideVelocities": lambda: HideVelocities("CartPole-v1"),
    "SequenceHistory": lambda: Compose(TargetReturn(100.0), SequenceHistory(3)),
}
OFFLINE: dict[str, Callable[[], Transform]] = {
    "History": ONLINE["History"],
    "HideVelocities": lambda: HideVelocities(
        "CartPole-v1", ["observation", ("next", "observation")]
    ),
}


def task() -> EnvBase:
    return GymEnv("CartPole-v1", max_episode_steps=7)


def transformed(name: str, env: EnvBase | None = None) -> TransformedEnv:
    return TransformedEnv(task() if env is None else env, ONLINE[name]())


def steps(name: str) -> tuple[TensorDictBase, TensorDictBase]:
    """Steps of the environment with the transform, and the same steps without it."""
    rollouts = []
    for env in (transformed(name), task()):
        torch.manual_seed(0)
        env.set_seed(0)
        rollouts.append(env.rollout(20, break_when_any_done=False))
    with_transform, without = rollouts
    assert with_transform["next", "done"].any()
    return with_transform, without


LAYOUTS: dict[str, Callable[[str], EnvBase]] = {
    "single": transformed,
    "inside-serial": lambda name: SerialEnv(2, lambda: transformed(name)),
    "around-serial": lambda name: transformed(name, SerialEnv(2, task)),
    "inside-parallel": lambda name: ParallelEnv(
        2, lambda: transformed(name), mp_start_method="forkserver"
    ),
}


@pytest.mark.parametrize(
    ("name", "lay_out"),
    [
        (name, lay_out)
        for name in ONLINE
        for lay_out in LAYOUTS
        if lay_out != "inside-parallel" or name == "History"
    ],
)
def test_specs_in_every_layout(name: str, lay_out: str) -> None:
    env = LAYOUTS[lay_out](name)
    try:
        check_env_specs(env)
    finally:
        env.close(raise_if_closed=False)


@pytest.mark.parametrize("name", ONLINE)
def test_inside_and_around_a_batch_are_the_same(name: str) -> None:
    rollouts = []
    for env in (SerialEnv(2, lambda: transformed(name)), transformed(name, SerialEnv(2, task))):
        torch.manual_seed(0)
        env.set_seed(0)
        rollouts.append(env.rollout(20, break_when_any_done=False))
    assert_close(*rollouts, rtol=0, atol=0)


@pytest.mark.parametrize("name", OFFLINE)
@pytest.mark.parametrize("wrap", [lambda x: x, Compose, lambda x: nn.Sequential(x, nn.Identity())])
def test_without_an_environment(name: str, wrap: Callable[[Transform], nn.Module]) -> None:
    expected, stored = steps(name)
    assert_close(wrap(OFFLINE[name]())(stored), expected, rtol=0, atol=0)


@pytest.mark.parametrize("name", OFFLINE)
@pytest.mark.parametrize("kind", [ReplayBuffer, TensorDictReplayBuffer])
def test_in_a_replay_buffer(name: str, kind: type[ReplayBuffer]) -> None:
    expected, stored = steps(name)
    buffer = kind(storage=LazyTensorStorage(1), batch_size=1)
    buffer.append_transform(OFFLINE[name]())
    buffer.add(stored)
    sample = buffer.sample()[0]
    assert_close(sample.select(*expected.keys(True, True)), expected, rtol=0, atol=0)


def test_sequences_are_made_in_environments_only() -> None:
    """For stored steps, there is `SequenceStorage`."""
    _, stored = steps("SequenceHistory")
    stored["target_return"] = torch.ones(20, 1)
    with pytest.raises(NotImplementedError, match="SequenceHistory"):
        nn.Sequential(SequenceHistory(3), nn.Identity())(stored)
    buffer = ReplayBuffer(storage=LazyTensorStorage(20), batch_size=4)
    buffer.append_transform(SequenceHistory(3))
    buffer.extend(stored)
    with pytest.raises(NotImplementedError, match="SequenceHistory"):
        buffer.sample()
