"""TorchRL's samplers, indices, transforms and prefetching, on storages that gather their items."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import (
    LazyTensorStorage,
    RandomSampler,
    ReplayBuffer,
    SamplerWithoutReplacement,
    SliceSampler,
    SliceSamplerWithoutReplacement,
    TensorDictReplayBuffer,
)

from tests.datasets.rollouts import Transitions
from tests.datasets.several import play_several
from torchrl_tit.datasets import (
    ConsecutiveSampler,
    Episodes,
    HistoryStorage,
    OnlineHistoryStorage,
    episodes_from_arrays,
)

Make = Callable[..., ReplayBuffer]


@pytest.fixture(scope="module")
def episodes(rolled: Transitions) -> Episodes:
    return episodes_from_arrays(**rolled)


def on_data(episodes: Episodes) -> Make:
    def make(kind: Any = ReplayBuffer, **settings: Any) -> ReplayBuffer:
        # The last transition of truncated episodes is left out, so nothing marks their ends.
        storage = HistoryStorage(episodes, 3, is_init=True, time_limits="drop")
        return kind(storage=storage, batch_size=24, **settings)

    return make


def on_ring(envs: int | None) -> Make:
    def make(kind: Any = ReplayBuffer, **settings: Any) -> ReplayBuffer:
        storage = OnlineHistoryStorage(
            40 * (envs or 1), 3, ndim=1 if envs is None else 2, is_init=True
        )
        buffer = kind(storage=storage, batch_size=24, **settings)
        steps = play_several(envs, 60, 3, "same").exclude("history", ("next", "history"))
        for batch in steps.split(25, -1):
            buffer.extend(batch)
        return buffer

    return make


@pytest.fixture(params=["data", "one", "many"])
def make(request: pytest.FixtureRequest, episodes: Episodes) -> Make:
    return {"data": on_data(episodes), "one": on_ring(None), "many": on_ring(3)}[request.param]


SAMPLERS: dict[str, Callable[[], Any]] = {
    "random": RandomSampler,
    "without replacement": SamplerWithoutReplacement,
    "consecutive": lambda: ConsecutiveSampler(4),
    "slices": lambda: SliceSampler(slice_len=2),
    "cached slices": lambda: SliceSampler(num_slices=12, cache_values=True),
    "short slices": lambda: SliceSampler(slice_len=4, strict_length=False),
    "slices without replacement": lambda: SliceSamplerWithoutReplacement(
        slice_len=2, strict_length=False
    ),
}


@pytest.mark.parametrize("name", SAMPLERS)
def test_samplers(make: Make, name: str) -> None:
    for kind in (ReplayBuffer, TensorDictReplayBuffer):
        buffer = make(kind, sampler=SAMPLERS[name](), prefetch=2)
        seen = []
        for _ in range(6):
            batch, info = buffer.sample(return_info=True)
            index = info["index"]
            seen.append(torch.stack(index, -1) if isinstance(index, tuple) else index)
            expected = buffer.storage.get(index)
            for key in set(expected.keys(True, True)) - set(info):
                assert torch.equal(batch[key], expected[key]), key
            if "slices" in name:
                check_slices(batch, marked=kind is TensorDictReplayBuffer)
        # Old and new, and of all environments.
        width = seen[0].shape[-1] if buffer.storage.ndim > 1 else 1
        drawn = torch.cat([x.reshape(-1, width) for x in seen])
        assert (drawn.amax(0) >= torch.tensor(buffer.storage.shape) * 3 // 4 - 1).all()


def check_slices(batch: TensorDictBase, marked: bool) -> None:
    """Steps follow one another within slices, which never leave an episode."""
    episode, done = batch["episode"], batch["next", "done"][:, 0]
    name = "observation" if isinstance(batch["observation"], Tensor) else ("observation", "camera")
    following = ("next", *((name,) if isinstance(name, str) else name))
    same = (batch[name][1:] == batch[following][:-1]).flatten(1).all(1)
    if marked:
        begins = batch["is_init"][1:, 0]
        assert torch.equal(done[:-1], begins)
        assert same[~begins].all()
        same &= ~begins  # of two slices, one can go on where the other ends
    assert same.any()
    assert not (same & (episode[1:] != episode[:-1])).any()
    assert not (same & done[:-1]).any()


INDICES: list[Any] = [
    0,
    -3,
    np.int64(4),
    slice(None),
    slice(3, -2, 2),
    range(2, 9, 3),
    [0, 5, -1],
    [],
    np.array([1, -2]),
    torch.tensor(7),
    torch.tensor([[0, 5], [-1, 2]], dtype=torch.int32),
    "mask",
    "numpy mask",
    "list mask",
    "full mask",
    "short mask",
    (slice(None), 1),
    (torch.tensor([4, 2]), torch.tensor([-1, 0])),
    (torch.tensor([4, 2]),),
    (torch.tensor([4, 2]), torch.tensor([3, 0])),
    10**6,
    -(10**6),
    [0, 10**6],
    torch.tensor([0.0, 1.0]),
    ...,
]


@pytest.mark.parametrize("index", INDICES, ids=str)
def test_indices_are_those_of_torchrls_storages(make: Make, index: Any) -> None:
    """Compared with a TorchRL storage of the same items; what it refuses, we refuse."""
    storage = make().storage
    items = storage.get(slice(None))
    theirs = LazyTensorStorage(items.numel(), ndim=storage.ndim)
    theirs.set(range(len(items)), items)
    if isinstance(index, str):
        mask = torch.arange(len(items)) % 3 == 1
        index = {
            "mask": mask,
            "numpy mask": mask.numpy(),
            "list mask": mask.tolist(),
            "full mask": torch.rand(storage.shape) < 0.3,
            "short mask": mask[:-1],
        }[index]
    expected = None
    with contextlib.suppress(IndexError):
        expected = theirs.get(index)
    if expected is None:
        with pytest.raises(IndexError) as error:
            storage.get(index)
        assert "\n" not in str(error.value)
        return
    found = storage.get(index)
    assert found.batch_size == expected.batch_size
    assert (found == expected).all()
    steps = storage[index]
    assert (steps == expected.select(*steps.keys(True, True))).all()


def drawn(sampler: ConsecutiveSampler, storage: Any) -> Tensor:
    index, _ = sampler.sample(storage, 40_000)
    flat = index[0] * storage.shape[1] + index[1] if isinstance(index, tuple) else index
    return flat.flatten().bincount(minlength=len(storage))


def test_consecutive_steps_are_drawn_equally(make: Make) -> None:
    """The ends of episodes too; only the oldest and newest steps are drawn less often."""
    storage = make().storage
    counts = drawn(ConsecutiveSampler(4), storage).view(storage.shape)
    if storage.oldest:
        counts = counts.roll(-storage.oldest, 0)  # the oldest first
    expected = 40_000 / (len(storage) - 3 * storage.shape[1:].numel())
    assert ((counts[3:-3] - expected).abs() < 6 * (4 * expected) ** 0.5).all()
    assert (counts[[0, -1]] > 0).all()
    assert (counts[[0, -1]] < 0.5 * expected).all()


def test_consecutive_steps_are_those_of_an_environment(make: Make) -> None:
    buffer = make(sampler=ConsecutiveSampler(4))
    for _ in range(10):
        batch = buffer.sample()
        assert batch.batch_size == (6, 4)
        goes_on = ~batch["is_init"][:, 1:, 0]
        assert torch.equal(batch["next", "is_init"], batch["is_init"])
        leaves = batch.select("history", ("next", "history")).flatten_keys()
        for name, history in batch.select("history").flatten_keys().items():
            following = leaves[f"next.{name}"]
            assert torch.equal(following[:, :-1][goes_on], history[:, 1:][goes_on])


def test_slices_that_cannot_be_drawn(make: Make) -> None:
    storage = make().storage
    with pytest.raises(ValueError, match="12 steps cannot be divided into slices of 5"):
        ConsecutiveSampler(5).sample(storage, 12)
    with pytest.raises(ValueError, match="consecutive steps, which is less than a slice of 1000"):
        ConsecutiveSampler(1000).sample(storage, 2000)
    with pytest.raises(ValueError, match="There are 0 consecutive steps"):
        ConsecutiveSampler(2).sample(OnlineHistoryStorage(10, ndim=2), 4)
