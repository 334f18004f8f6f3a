"""History writes the last K observations of each environment, and nothing else."""

import warnings
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer, SliceSampler
from torchrl.envs import (
    Compose,
    DTypeCastTransform,
    ObservationNorm,
    PendulumEnv,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from tests.transforms.streams import StreamEnv, assert_histories
from torchrl_tit.transforms import History


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("num_frames", [1, 2, 5])
@pytest.mark.parametrize("num_envs", [1, 4])
def test_equals_the_plain_reference(num_envs, num_frames, padding):
    env = TransformedEnv(StreamEnv([num_envs]), History(num_frames, padding=padding))
    assert_histories(env, num_frames, padding)


def test_without_a_batch():
    env = TransformedEnv(StreamEnv([], shape=(2,)), History(3))
    check_env_specs(env)
    first = env.reset()
    assert torch.equal(first["history"], first["observation"].expand(3, 2))


def test_an_environment_that_takes_any_batch_size():
    env = TransformedEnv(PendulumEnv(), History(3, "th"))
    for batch in ([5], [], [2, 3], [5]):
        first = env.reset(env.base_env.gen_params(batch_size=batch))
        steps = env.rollout(4, auto_reset=False, tensordict=first).refine_names(..., "time")
        made = History(3, "th")(steps.exclude("history", ("next", "history")))
        assert torch.equal(steps["history"], made["history"])
        assert steps["history"].shape == (*batch, 4, 3)


def test_a_transform_before_it_may_change_the_dtype():
    env = TransformedEnv(StreamEnv([3], dtype=torch.uint8), Compose(History(4)))
    env.insert_transform(0, DTypeCastTransform(torch.uint8, torch.float32, ["observation"]))
    env.insert_transform(1, ObservationNorm(0.5, 1 / 255, in_keys=["observation"]))
    assert_histories(env, 4, "same")


def test_a_new_environment_takes_the_state():
    env, other = (TransformedEnv(StreamEnv([3], seed=seed), History(4)) for seed in (0, 1))
    env.rollout(9, break_when_any_done=False)
    (saved,) = env.state_dict().values()
    assert saved.any()
    other.load_state_dict(env.state_dict())
    assert torch.equal(*[each.state_dict()["_cat_buffers_observation"] for each in (env, other)])


@pytest.mark.parametrize("padding", ["same", "constant"])
def test_next_observations_can_be_named_as_for_cat_frames(padding):
    env = TransformedEnv(StreamEnv([4]), History(3, padding=padding))
    rollout = env.rollout(30, break_when_any_done=False)
    stored = rollout.exclude("history", ("next", "history"))
    keys = ["observation", ("next", "observation")], ["history", ("next", "history")]
    again = History(3, *keys, padding=padding)(stored)
    assert torch.equal(again["history"], rollout["history"])
    assert torch.equal(again["next", "history"], rollout["next", "history"])
    same = TransformedEnv(StreamEnv([4]), History(3, *keys, padding=padding))
    assert_histories(same, 3, padding)


def stored_once(history: History, **settings: Any) -> tuple[TensorDictBase, ReplayBuffer]:
    """Steps with the environment's histories, and a buffer that stores them without."""
    rollout = TransformedEnv(StreamEnv([]), history).rollout(50, break_when_any_done=False)
    buffer = ReplayBuffer(storage=LazyTensorStorage(50), batch_size=64, **settings)
    buffer.extend(rollout.exclude("history", ("next", "history")))
    return rollout, buffer


def steps_of(sample: TensorDictBase, rollout: TensorDictBase) -> torch.Tensor:
    """Which step of the rollout each sampled one is."""
    same = sample["observation"].unsqueeze(1) == rollout["observation"].unsqueeze(0)
    return same.all(-1).int().argmax(1)


@pytest.mark.parametrize("padding", ["same", "constant"])
def test_a_replay_buffer_makes_histories_of_observations_stored_once(padding):
    """Those of the environment, without a warning."""
    history = History(3, padding=padding)
    transform, sampler = history.make_rb_transform_and_sampler(batch_size=64)
    rollout, buffer = stored_once(history, transform=transform, sampler=sampler)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sample = buffer.sample()
    assert sample.batch_size == (64,)
    expected = rollout[steps_of(sample, rollout)]
    assert torch.equal(sample["history"], expected["history"])
    assert torch.equal(sample["next", "history"], expected["next", "history"])
    buffer.empty()
    buffer.extend(rollout.clone())
    assert "history" not in buffer.storage[:].keys()  # noqa: SIM118 (a tensordict)
    with pytest.raises(ValueError, match="strict_length=False cannot be: use an OnlineHistory"):
        history.make_rb_transform_and_sampler(batch_size=64, strict_length=False)


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("shape", [(-1,), (16, 4)])
def test_histories_of_slices_end_where_the_slices_begin(padding, shape):
    """In batches [slices, steps] and in flat ones, where no flag marks the slices."""
    history = History(3, padding=padding)
    transform = Compose(lambda steps: steps.reshape(*shape), History(3, padding=padding))
    sampler = SliceSampler(slice_len=4, end_key=("next", "done"))
    _, buffer = stored_once(history, transform=transform, sampler=sampler)
    sample = buffer.sample().reshape(16, 4)
    frames = sample["observation"]
    pad = frames[:, 0] if padding == "same" else torch.zeros_like(frames[:, 0])
    known = torch.stack([pad, pad, *frames.unbind(1), sample["next", "observation"][:, -1]], 1)
    for start in range(4):
        expected = known[:, start : start + 3]
        assert torch.equal(sample["history"][:, start], expected)
        assert torch.equal(sample["next", "history"][:, start], known[:, start + 1 : start + 4])


def test_is_init_begins_a_history():
    steps = TransformedEnv(StreamEnv([2]), History(3)).rollout(4, break_when_any_done=False)
    steps["next", "done"][:] = False
    steps["next", "observation"][:, :-1] = steps["observation"][:, 1:]
    steps["is_init"] = torch.tensor([[0, 0, 1, 0]] * 2, dtype=torch.bool).unsqueeze(-1)
    history = History(3)(steps)["history"]
    frames = steps["observation"]
    assert torch.equal(history[:, 1], frames[:, [0, 0, 1]])
    assert torch.equal(history[:, 3], frames[:, [2, 2, 3]])


def test_steps_that_are_no_slices_are_refused():
    _, buffer = stored_once(History(3), transform=History(3))
    with pytest.raises(ValueError, match=r"no slices .*draw them with a SliceSampler") as error:
        buffer.sample()
    assert "\n" not in str(error.value)
    _, buffer = stored_once(History(3))
    flat = buffer.sample().exclude(("next", "observation"))
    with pytest.raises(ValueError, match="nothing tells where slices of these steps begin"):
        History(3)(flat)
    with pytest.raises(ValueError, match="a single step has no history"):
        History(3)(flat[0])


def test_keys_of_histories() -> None:
    assert History(2, in_keys=["pixels"]).out_keys == ["history"]
    assert History(2, in_keys=[("agents", "observation_1")]).out_keys == [("agents", "history_1")]
    several = ["observation", "pixels", ("arm", "left"), ("observation", "own_observation")]
    names = ["observation", "pixels", "arm/left", "own_observation"]
    assert History(2, in_keys=several).out_keys == [("history", name) for name in names]
    stored = ["pixels", ("next", "pixels")]
    assert History(2, in_keys=stored).out_keys == ["history"]


@pytest.mark.parametrize("wrap", [lambda history: history, lambda history: Compose(history)])
def test_wrong_environment(wrap):
    with pytest.raises(ValueError, match=r"shape \[2, 4, 5\], so observation_ndim must be 3"):
        TransformedEnv(StreamEnv([3], shape=(2, 4, 5)), wrap(History(2, observation_ndim=1)))
    with pytest.raises(KeyError, match=r"'pixels' in the environment, which has \['observation'\]"):
        TransformedEnv(StreamEnv([3]), wrap(History(2, in_keys=["pixels"])))
