"""A collector that is restored returns the same batches as the saved one."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, SerialEnv
from torchrl.modules import NormalParamExtractor, ProbabilisticActor, TanhNormal

from tests.checkpoint.test_environment import assert_bit_equal, make_single, make_vector
from torchrl_tit.checkpoint import (
    collector_state,
    global_rng_state,
    load_checkpoint,
    save_checkpoint,
    set_collector_state,
    set_global_rng_state,
)
from torchrl_tit.envs import make_env


def make_policy(env: EnvBase) -> ProbabilisticActor:
    """Reads the history, so that every frame of it counts."""
    history = env.observation_spec["history"].shape[-2:].numel()
    if not env.action_spec.dtype.is_floating_point:
        net = nn.Sequential(nn.Flatten(-2), nn.Linear(history, 2))
        module = TensorDictModule(net, ["history"], ["logits"])
        return ProbabilisticActor(
            module, ["logits"], distribution_class=torch.distributions.Categorical
        )
    size = env.action_spec.shape[-1]
    net = nn.Sequential(nn.Flatten(-2), nn.Linear(history, 2 * size), NormalParamExtractor())
    module = TensorDictModule(net, ["history"], ["loc", "scale"])
    return ProbabilisticActor(module, ["loc", "scale"], distribution_class=TanhNormal)


def make_own_vector(name: str, num_envs: int, max_episode_steps: int) -> EnvBase:
    return make_env(name, num_envs, num_frames=4, max_episode_steps=max_episode_steps)


def make_collector(
    name: str,
    track: bool = True,
    init_random_frames: int = 0,
    make: Callable[..., EnvBase] = make_vector,
) -> Collector:
    torch.manual_seed(0)
    env = make(name, 3, max_episode_steps=21)
    env.set_seed(1)
    return Collector(
        env,
        make_policy(env),
        frames_per_batch=48,
        total_frames=48 * 6,
        init_random_frames=init_random_frames,
        track_traj_ids=track,
        auto_register_policy_transforms=False,
    )


def collect(collector: Collector, batches: int) -> list[TensorDictBase]:
    iterator = iter(collector)
    return [next(iterator).clone() for _ in range(batches)]


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1", "Hopper-v5"])
@pytest.mark.parametrize("track", [True, False], ids=["tracked", "untracked"])
@pytest.mark.parametrize("make", [make_vector, make_own_vector])
def test_resumes_bit_for_bit(
    tmp_path: Path, name: str, track: bool, make: Callable[..., EnvBase]
) -> None:
    first = make_collector(name, track, make=make)
    collect(first, 2)
    save_checkpoint(tmp_path, 96, {"collector": collector_state(first), "rng": global_rng_state()})
    expected = collect(first, 4)
    assert any(batch["next", "done"].any() for batch in expected)

    second = make_collector(name, track, make=make)
    torch.manual_seed(123)
    step, state = load_checkpoint(tmp_path)
    assert step == 96
    set_collector_state(second, state["collector"])
    set_global_rng_state(state["rng"])
    got = list(map(TensorDictBase.clone, second))
    assert len(got) == 4  # it knows how many frames are left
    for left, right in zip(got, expected, strict=True):
        assert_bit_equal(left, right)
        assert (("collector", "traj_ids") in left.keys(True)) == track
    assert second._iter == first._iter
    first.shutdown()
    second.shutdown()


def test_random_frames_are_counted_on() -> None:
    first = make_collector("CartPole-v1", init_random_frames=96)
    collect(first, 1)
    state = collector_state(first)
    rng = global_rng_state()
    expected = collect(first, 2)
    second = make_collector("CartPole-v1", init_random_frames=96)
    set_collector_state(second, state)
    set_global_rng_state(rng)
    for left, right in zip(collect(second, 2), expected, strict=True):
        assert_bit_equal(left, right)


def test_of_an_environment_that_cannot_be_saved_only_the_counters(tmp_path: Path) -> None:
    def make() -> Collector:
        env = SerialEnv(2, lambda: make_single("CartPole-v1"))
        return Collector(
            env,
            make_policy(env),
            frames_per_batch=20,
            total_frames=80,
            auto_register_policy_transforms=False,
        )

    first, second = make(), make()
    collect(first, 3)
    save_checkpoint(tmp_path, 60, collector_state(first))
    _, state = load_checkpoint(tmp_path)
    assert state["env"] is None
    assert state["carried"] is None
    set_collector_state(second, state)
    assert second._frames == 60
    first.reset()
    second.reset()
    ids = [collect(each, 1)[0]["collector", "traj_ids"][:, 0].tolist() for each in (first, second)]
    assert ids[0] == ids[1]
    assert len(list(second)) == 0


def test_tracking_must_agree() -> None:
    first, second = make_collector("CartPole-v1", True), make_collector("CartPole-v1", False)
    with pytest.raises(ValueError, match="only one of the saved collector"):
        set_collector_state(second, collector_state(first))
