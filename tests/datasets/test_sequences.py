"""Subsequences against the plainest way to cut them."""

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from tests.datasets.rollouts import Transitions, spans
from torchrl_tit.datasets import (
    DatasetError,
    SequenceStorage,
    episodes_from_arrays,
    make_replay_buffer,
)


def reference(
    arrays: Transitions, start: int, stop: int, step: int, num_frames: int, scale: float
) -> dict[str, np.ndarray]:
    """Steps of one episode from one on, one after the other, padded on the left."""
    length = min(num_frames, stop - start - step)
    rows: dict[str, list] = {
        "observation": [np.zeros(11)] * (num_frames - length),
        "action": [np.full(3, -10.0)] * (num_frames - length),
        "return_to_go": [np.zeros(1)] * (num_frames - length),
        "timestep": [0] * (num_frames - length),
        "mask": [False] * (num_frames - length),
    }
    for t in range(step, step + length):
        rows["observation"].append(arrays["observations"][start + t])
        rows["action"].append(arrays["actions"][start + t])
        to_go = arrays["rewards"][start + t : stop].sum(dtype=np.float64) / scale
        rows["return_to_go"].append(np.array([to_go]))
        rows["timestep"].append(t)
        rows["mask"].append(True)
    return {name: np.array(values) for name, values in rows.items()}


@pytest.mark.parametrize("num_frames", [1, 5, 20])
@pytest.mark.parametrize("with_next", [True, False])
def test_every_item(arrays: Transitions, num_frames: int, with_next: bool) -> None:
    if not with_next:  # whose final observations are unknown, which no sequence needs
        del arrays["next_observations"]
    storage = SequenceStorage(episodes_from_arrays(**arrays), num_frames, return_scale=10.0)

    items = storage.get(slice(None))

    index = 0
    for start, stop in spans(arrays):
        for step in range(stop - start):
            expected = reference(arrays, start, stop, step, num_frames, 10.0)
            for name, values in expected.items():
                np.testing.assert_allclose(
                    items[name][index].numpy(), values, rtol=1e-6, atol=1e-6, err_msg=name
                )
            index += 1
    assert len(storage) == index == len(arrays["rewards"])
    assert items["mask"].dtype == torch.bool
    assert items["timestep"].dtype == torch.int64


def test_trailing_unfinished_episode_is_removed(arrays: Transitions) -> None:
    start, _ = spans(arrays)[-1]
    episodes = episodes_from_arrays(**{name: array[:-1] for name, array in arrays.items()})
    assert len(SequenceStorage(episodes)) == start


def test_statistics_are_those_of_finished_episodes(arrays: Transitions) -> None:
    start, _ = spans(arrays)[-1]
    episodes = episodes_from_arrays(**{name: array[:-1] for name, array in arrays.items()})
    observations = arrays["observations"][:start].astype(np.float64)

    mean, std = episodes.observation_statistics()

    np.testing.assert_allclose(mean, observations.mean(0), rtol=1e-6)
    np.testing.assert_allclose(std, observations.std(0), rtol=1e-6)


def test_episodes_are_drawn_by_length_and_starts_uniformly(arrays: Transitions) -> None:
    lengths = np.array([1, 4, 10])
    ends = np.isin(np.arange(15), lengths.cumsum() - 1)
    episodes = episodes_from_arrays(
        np.repeat(np.arange(3.0), lengths)[:, None], np.zeros((15, 1)), np.zeros(15), ends
    )
    buffer = make_replay_buffer(SequenceStorage(episodes, 1), 30_000)

    batch = buffer.sample()

    episode, step = batch["observation"].flatten().long(), batch["timestep"].flatten()
    counts = torch.stack([episode, step]).unique(dim=1, return_counts=True)[1]
    assert len(counts) == 15
    assert ((counts - 2000).abs() < 5 * 2000**0.5).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_frames": 0}, "num_frames must be at least 1, not 0"),
        ({"return_scale": 0.0}, "return_scale must be positive"),
    ],
)
def test_wrong_settings(rolled: Transitions, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SequenceStorage(episodes_from_arrays(**rolled), **settings)


@pytest.mark.parametrize("dtype", [np.uint8, np.int8, np.int64, bool])
@pytest.mark.parametrize("shape", [(), (2,)])  # indices, and one-hot
def test_padding_of_discrete_actions(dtype: type, shape: tuple[int, ...]) -> None:
    actions: NDArray = np.ones((6, *shape), dtype)
    ends = np.arange(6) == 5
    episodes = episodes_from_arrays(np.zeros((6, 3)), actions, np.ones(6), ends)
    action = SequenceStorage(episodes, 3)[4]["action"]
    assert action.dtype == torch.int64
    assert action.reshape(3, -1).unique(dim=1).flatten().tolist() == [-10, 1, 1]


def test_returns_to_go_of_long_data_stay_exact() -> None:
    rewards = np.concatenate([np.full(200_000, 1e3), [0.1, 0.2], np.full(200_000, 1e3)])
    ends = np.zeros(len(rewards), dtype=bool)
    ends[[199_999, 200_001, -1]] = True
    states = np.zeros((len(rewards), 1))
    storage = SequenceStorage(episodes_from_arrays(states, states, rewards, ends), 2)
    item = storage[200_000]["return_to_go"].flatten() * 1000
    torch.testing.assert_close(item, torch.tensor([0.3, 0.2]), rtol=1e-5, atol=0)


def test_no_finished_episode_is_an_error(arrays: Transitions) -> None:
    arrays["terminals"][:], arrays["timeouts"][:] = False, False
    with pytest.raises(DatasetError, match="no episode ends"):
        episodes_from_arrays(**arrays)
