"""A ring of collected steps keeps each frame once, and its histories are the environment's."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import ReplayBuffer, SliceSampler
from torchrl.envs import MultiStepTransform

from recipes.replay import BufferState
from tests.datasets.several import MOST_FRAMES, newest, play_several
from torchrl_tit.checkpoint import checkpoint_steps
from torchrl_tit.datasets import ConsecutiveSampler, OnlineHistoryStorage

STEPS = 60
EXTRA = ("episode", "is_init", ("next", "is_init"))


def without_histories(steps: TensorDictBase) -> TensorDictBase:
    return steps.exclude("history", ("next", "history"))


def make(envs: int | None, max_size: int, num_frames: int, **settings: Any) -> ReplayBuffer:
    ndim = 1 if envs is None else 2
    storage = OnlineHistoryStorage(max_size, num_frames, ndim=ndim, **settings)
    return ReplayBuffer(storage=storage, batch_size=16)


def batches(steps: TensorDictBase, generator: torch.Generator) -> Iterator[tuple[int, Any]]:
    """Splits steps [..., T] at random; yields the time after each batch, and the batch."""
    time, total = 0, steps.shape[-1]
    while time < total:
        stop = min(total, time + int(torch.randint(1, 25, (), generator=generator)))
        yield stop, without_histories(steps[..., time:stop])
        time = stop


def end_frames(buffer: ReplayBuffer) -> int:
    """Number of frames that are stored because an episode ended."""
    return buffer.storage._end_frames.stop - buffer.storage._end_frames.first


def assert_items(items: TensorDictBase, expected: TensorDictBase) -> None:
    assert set(items.exclude(*EXTRA).keys(True, True)) == set(expected.keys(True, True))
    for key in expected.keys(True, True):
        assert items[key].dtype == expected[key].dtype
        assert torch.equal(items[key], expected[key]), key


@pytest.mark.parametrize("seed", range(12))
def test_items_are_those_of_the_environment(seed: int, tmp_path: Path) -> None:
    """Random episodes, batches and sizes, up to a batch that is larger than the ring.

    A ring that is saved in parts and restored at a random moment goes on as the whole one.
    """
    generator = torch.Generator().manual_seed(seed)

    def draw(low: int, high: int) -> int:
        return int(torch.randint(low, high, (), generator=generator))

    envs, num_frames = (None, 1, 3)[seed % 3], draw(1, MOST_FRAMES + 1)
    padding = ("same", "constant")[seed % 2]
    max_size = draw(1, 30) * (envs or 1)
    steps = play_several(envs, STEPS, num_frames, padding)
    settings = {"padding": padding, "is_init": True}
    buffer, restored = (make(envs, max_size, num_frames, **settings) for _ in range(2))
    state = BufferState(buffer, tmp_path)
    resume_at = draw(0, STEPS)
    resumed = False
    for time, batch in batches(steps, generator):
        index = buffer.extend(batch)
        assert_items(buffer.storage.get(slice(None)), newest(steps, time, buffer.storage.max_size))
        stored = index.flatten(0, -2).unique(dim=0) if index.ndim > 1 else index.unique()
        assert len(buffer) >= len(stored)
        if resumed:
            assert torch.equal(restored.extend(batch), index)
            assert (restored.storage.get(slice(None)) == buffer.storage.get(slice(None))).all()
        saved = state.state_dict()
        if not resumed and time >= resume_at:
            BufferState(restored, tmp_path).load_state_dict(saved)
            resumed = True
            assert (restored.storage.get(slice(None)) == buffer.storage.get(slice(None))).all()
    # What belongs to overwritten steps is gone.
    ended = newest(steps, STEPS, buffer.storage.max_size)["next", "done"].sum()
    assert ended <= end_frames(buffer) <= ended + 2 * (envs or 1)
    again = make(envs, max_size, num_frames, **settings)
    buffer.dumps(tmp_path / "whole")
    again.loads(tmp_path / "whole")
    assert (again.storage.get(slice(None)) == buffer.storage.get(slice(None))).all()
    more = without_histories(play_several(envs, 9, num_frames, padding, seed=1))
    for each in (buffer, again, restored):
        each.extend(more)
    assert (again.storage.get(slice(None)) == buffer.storage.get(slice(None))).all()
    assert (restored.storage.get(slice(None)) == buffer.storage.get(slice(None))).all()


@pytest.mark.parametrize("envs", [None, 3])
@pytest.mark.parametrize("make_copy", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_a_copy_goes_on_by_itself(envs: int | None, make_copy: Callable[[Any], Any]) -> None:
    steps = play_several(envs, STEPS, 4, "same")
    buffer = make(envs, 20 * (envs or 1), 4)
    buffer.extend(without_histories(steps[..., :30]))
    other = make_copy(buffer)
    for time, each in ((STEPS, other), (30, buffer)):
        if time > 30:
            each.extend(without_histories(steps[..., 30:]))
        assert_items(each.storage.get(slice(None)), newest(steps, time, 20 * (envs or 1)))


def test_batches_of_several_workers_are_not_one_sequence() -> None:
    """Those that come one after the other; without "is_init", the environment may be reset."""
    workers = without_histories(play_several(3, 12, 2, "same"))
    workers["is_init"] = torch.zeros(3, 12, 1, dtype=torch.bool)
    workers["is_init"][:, 1:] = workers["next", "done"][:, :-1]
    workers["is_init"][:, 4] = True  # reset without a flag
    make(3, 36, 2).extend(workers)
    buffer = make(None, 30, 2)
    buffer.extend(workers[0, :6])
    with pytest.raises(ValueError, match=r"batches of several workers .* ndim=2"):
        buffer.extend(workers[1, 6:])
    assert len(buffer) == 6
    buffer = make(None, 30, 2)
    for worker in workers:
        buffer.extend(worker.exclude("is_init"))


def test_histories_that_would_be_replaced_by_others_are_refused() -> None:
    """They tell where an episode goes on that would begin here, and how it is padded."""
    steps = play_several(2, STEPS, 3, "constant")
    done = steps["next", "done"].squeeze(-1).any(0)
    before = 2 + int((~(done[:-1] | done[1:])).nonzero()[0])  # inside an episode of both
    make(2, 90, 3, padding="constant").extend(steps)
    make(2, 90, 3, padding="constant").extend(steps[:, before:].exclude("history"))
    refused = pytest.raises(ValueError, match=r"Histories .* begin an episode .* a storage of its")
    with refused:
        make(2, 90, 3, padding="same").extend(steps)
    with refused:  # the first step that is ever written begins an episode
        make(2, 90, 3, padding="constant").extend(steps[:, before:])
    buffer = make(None, 90, 3, padding="constant")
    buffer.extend(steps[0, :before])
    with refused:  # of another worker
        buffer.extend(steps[1, before:])
    assert len(buffer) == before


def test_is_init_and_episode() -> None:
    steps = play_several(3, STEPS, 4, "same")
    buffer = make(3, 3 * STEPS, 4, is_init=True)
    buffer.extend(without_histories(steps))
    starts = torch.ones(3, STEPS, dtype=torch.bool)
    starts[:, 1:] = steps["next", "done"][:, :-1, 0]
    starts[:, STEPS // 3] = True  # reset without a flag
    items = buffer.storage.get(slice(None)).transpose(0, 1)
    for group in (items, items["next"]):
        assert torch.equal(group["is_init"][..., 0], starts)
    number = torch.arange(3).unsqueeze(1) * STEPS + starts.cumsum(1)
    _, expected = number.unique(return_inverse=True)
    _, episode = items["episode"].unique(return_inverse=True)
    for ours, theirs in ((episode, expected), (expected, episode)):  # one to one
        pairs = torch.stack([ours, theirs], -1).flatten(0, 1).unique(dim=0)
        assert len(pairs) == len(ours.unique())


def test_one_observation_and_single_steps() -> None:
    """Frames that are not equal to themselves; steps that are added one by one."""
    frames = torch.zeros(6, 2)
    frames[:, 1] = torch.nan
    flag = torch.zeros(6, 1, dtype=torch.bool)
    outcome = {"observation": frames, "reward": torch.ones(6, 1), "terminated": flag, "done": flag}
    steps = TensorDict({"observation": frames, "action": torch.arange(6), "next": outcome}, [6])
    begins = flag.clone()
    begins[4] = True
    for is_init, starts in ((None, [0]), (begins, [0, 4])):
        buffer = make(None, 6, 3, is_init=True)
        given = steps if is_init is None else steps.copy().set("is_init", is_init)
        buffer.extend(given[:3])
        for step in given[3:]:
            buffer.add(step)
        assert (
            buffer.storage.get(slice(None))["is_init"].flatten().nonzero().flatten().tolist()
            == starts
        )
        assert end_frames(buffer) == len(starts) - 1
        assert buffer.storage.get(slice(None))["action"].tolist() == list(range(6))


def test_parts_that_no_checkpoint_needs_are_removed(tmp_path: Path) -> None:
    """Of the last two checkpoints and of one that may not be complete, each can be loaded."""
    steps = without_histories(play_several(3, STEPS, 4, "same"))
    buffer = make(3, 3 * 10, 4)
    state, saved, whole = BufferState(buffer, tmp_path, checkpoints=2), [], []
    for batch in steps.split(4, 1):
        buffer.extend(batch)
        saved.append(state.state_dict())
        whole.append(buffer.storage.get(slice(None)).clone())
    # 10 + 3 frames are in the last 4 parts, and the two checkpoints before need 2 more.
    assert checkpoint_steps(tmp_path) == [12 * n for n in range(10, 16)]
    assert saved[-1]["parts"] == [12 * n for n in range(12, 16)]
    for parts, expected in zip(saved[-3:], whole[-3:], strict=True):
        restored = make(3, 3 * 10, 4)
        other = BufferState(restored, tmp_path, checkpoints=2)
        other.load_state_dict(parts)
        assert (restored.storage.get(slice(None)) == expected).all()
    assert state.state_dict() == saved[-1]  # nothing new


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu() -> None:
    steps = play_several(3, STEPS, 4, "same")
    buffers = [make(3, 60, 4, device=device) for device in ("cuda", "cuda", "cpu")]
    for batch in without_histories(steps).split(9, 1):
        for buffer in buffers[::2]:
            buffer.extend(batch)
    buffers[1].load_state_dict(buffers[0].state_dict())
    for buffer in buffers:
        assert buffer.sample()["history", "camera"].device.type == buffer.storage.device.type
        assert_items(buffer.storage.get(slice(None)).cpu(), newest(steps, STEPS, 60))


def test_a_reset_that_shows_after_a_part_was_saved() -> None:
    steps = play_several(3, STEPS, 4, "same")
    restored = make(3, 3 * STEPS, 4).storage
    buffer = make(3, 3 * STEPS, 4)
    before = 0
    for batch in without_histories(steps).split([STEPS // 3, STEPS - STEPS // 3], 1):
        buffer.extend(batch)
        restored.add_part(buffer.storage.part(before))
        before = buffer.storage.num_written
    assert_items(restored.get(slice(None)), newest(steps, STEPS, 3 * STEPS))


def test_no_slice_leads_from_the_newest_step_to_the_oldest() -> None:
    """Of an episode that is longer than the ring."""
    frames, flag = torch.arange(26.0).unsqueeze(1), torch.zeros(25, 1, dtype=torch.bool)
    outcome = {"observation": frames[1:], "reward": frames[1:], "terminated": flag, "done": flag}
    steps = {"observation": frames[:-1], "action": torch.arange(25), "next": outcome}
    buffer = make(None, 10, 3)
    buffer.extend(TensorDict(steps, [25]))
    for sampler in (SliceSampler(slice_len=4), ConsecutiveSampler(4)):
        buffer.set_sampler(sampler)
        drawn = torch.cat([buffer.sample()["action"].view(4, 4) for _ in range(10)])
        assert (drawn.diff(dim=1) == 1).all()
        assert set(drawn.flatten().tolist()) == set(range(15, 25))


@pytest.mark.parametrize("envs", [None, 2])
def test_an_episode_that_a_resume_cut_off_stays_cut_off(envs: int | None, tmp_path: Path) -> None:
    """Also where the new episode begins with the very observation that the old one lacked."""
    shape = [8] if envs is None else [envs, 8]
    frames = torch.ones(*shape, 1)
    flag = torch.zeros(*shape, 1, dtype=torch.bool)
    outcome = {"observation": frames, "reward": frames, "terminated": flag, "done": flag}
    steps = TensorDict({"observation": frames, "action": flag, "next": outcome}, shape)
    before = make(envs, 8 * (envs or 1), 3, is_init=True, padding="constant")
    before.extend(steps[..., :5])
    state = BufferState(before, tmp_path).state_dict()
    items = []
    for _ in range(2):  # the second time from a checkpoint after the cut
        buffer = make(envs, 8 * (envs or 1), 3, is_init=True, padding="constant")
        saving = BufferState(buffer, tmp_path)
        saving.load_state_dict(state)
        if buffer.storage.num_written < 8 * (envs or 1):
            buffer.storage.end_episodes()
            buffer.extend(steps[..., 5:])
        state = saving.state_dict()
        whole = buffer.storage.get(slice(None))
        items.append(whole.reshape(8, -1).transpose(0, 1))
    assert (items[0] == items[1]).all()
    for one in items[0]:
        assert one["is_init"].flatten().nonzero().flatten().tolist() == [0, 5]
        assert one["episode"][4] != one["episode"][5]
        # The last step before the cut bootstraps from its own next history.
        assert one["next", "history"][4].flatten().tolist() == [1, 1, 1]
        assert one["history"][5].flatten().tolist() == [0, 0, 1]
        assert not one["next", "terminated"].any()


def test_what_is_refused() -> None:
    steps = without_histories(play_several(3, 12, 2, "same"))
    buffer = make(3, 31, 2)
    storage = buffer.storage
    assert not len(storage)
    with pytest.raises(IndexError, match="no items yet"):
        storage.get(0)
    with pytest.raises(KeyError, match="reward"):
        buffer.extend(steps.exclude(("next", "reward")))
    buffer = make(3, 31, 2)
    buffer.extend(steps[:, :9])
    storage = buffer.storage
    assert storage.max_size == 33  # whole steps of all environments
    with pytest.raises(RuntimeError, match="cannot be changed"):
        storage[0] = steps[:, 0]
    with pytest.raises(RuntimeError, match=r"index 9, but is to be written at \[4\]"):
        storage.set(range(4, 6), steps[:, :2].transpose(0, 1))
    with pytest.raises(ValueError, match="steps of 2 environments, but 3 were stored"):
        storage.set(range(9, 10), steps[:2, :1].transpose(0, 1))
    with pytest.raises(ValueError, match=r"ndim=1 takes steps \[T\], but these are \[3, 12\]"):
        make(None, 31, 2).extend(steps)
    whole = play_several(3, 12, 2, "same")
    make(3, 31, 2).extend(whole)
    whole["observation"].apply_(lambda x: x.add_(1))
    with pytest.raises(ValueError, match="not the newest frame of the histories"):
        make(3, 31, 2).extend(whole)
    other = make(3, 33, 4)
    with pytest.raises(ValueError, match="num_frames=2, but this storage has num_frames=4"):
        other.storage.load_state_dict(storage.state_dict())
    with pytest.raises(ValueError, match="begin at 15, but 27 were written: add all parts"):
        storage.add_part(storage.part(15))


def test_steps_of_several_steps_are_refused() -> None:
    """Their next observations do not follow, so each would be an episode of its own."""
    buffer = make(3, 90, 2)
    buffer.append_transform(MultiStepTransform(n_steps=3, gamma=0.9))
    with pytest.raises(ValueError, match="next observations are n steps away"):
        buffer.extend(without_histories(play_several(3, STEPS, 2, "same")))
