"""Items cut out of data sets: histories as in the environment, and sequences."""

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, GymEnv, TransformedEnv

from tests.datasets.rollouts import Transitions, spans
from tests.transforms.streams import StreamEnv
from torchrl_tit.datasets import (
    DatasetError,
    Episodes,
    HistoryStorage,
    SequenceStorage,
    episodes_from_arrays,
    make_replay_buffer,
    select_episodes,
    split_episodes,
)
from torchrl_tit.transforms import History

EVERY = slice(None)


def store(stream: TensorDictBase) -> Episodes:
    """Stores a rollout of an environment as episodes, without histories."""
    following = stream["next"]
    terminals = following["terminated"][:, 0]
    return episodes_from_arrays(
        stream["observation"],
        stream["action"],
        following["reward"],
        terminals,
        following["done"][:, 0] & ~terminals,
        following["observation"],
    )


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("num_frames", [1, 2, 4, 20])
@pytest.mark.parametrize("images", [False, True])
def test_windows_are_those_of_catframes(num_frames: int, padding: Any, images: bool) -> None:
    base: EnvBase = GymEnv("Hopper-v5", max_episode_steps=12)
    base = StreamEnv((), (6, 5), torch.uint8) if images else base
    ndim = base.observation_spec["observation"].ndim
    history = History(num_frames, observation_ndim=ndim, padding=padding)
    env = TransformedEnv(base, history)
    env.set_seed(0)
    stream = env.rollout(150, break_when_any_done=False)
    assert stream["next", "terminated"].any()

    storage = HistoryStorage(store(stream), num_frames, padding=padding, unfinished="keep")
    sample = storage.get(EVERY)

    assert sample.batch_size == (150,)
    assert sample["history"].dtype == (torch.uint8 if images else torch.float32)
    for key in set(sample.keys(True, True)) & set(stream.keys(True, True)):
        torch.testing.assert_close(sample[key], stream[key].to(sample[key].dtype), rtol=0, atol=0)


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("time_limits", ["keep", "drop"])
@pytest.mark.parametrize("terminals", ["keep", "zero"])
def test_settings_of_d3rlpy_1(
    arrays: Transitions, padding: Any, time_limits: Any, terminals: Any
) -> None:
    arrays["terminals"][arrays["timeouts"].argmax()] = True  # both at once count as terminal
    episodes = episodes_from_arrays(**arrays)
    settings = {"time_limits": time_limits, "terminal_observations": terminals}

    sample = HistoryStorage(episodes, 4, padding=padding, **settings).get(EVERY)

    drawn = ~arrays["timeouts"] | arrays["terminals"] | (time_limits == "keep")
    hidden = arrays["terminals"][drawn][:, None] & (terminals == "zero")
    following = np.where(hidden, 0, arrays["next_observations"][drawn])
    history, moved = sample["history"], sample["next", "history"]
    np.testing.assert_array_equal(history[:, -1].numpy(), arrays["observations"][drawn])
    np.testing.assert_array_equal(moved[:, -1].numpy(), following)
    assert torch.equal(moved[:, :-1], history[:, 1:])
    assert torch.equal(sample["observation"], history[:, -1])
    assert torch.equal(sample["next", "observation"], moved[:, -1])
    # No entry is a view of another, or of the data.
    for key in sample.keys(True, True):
        sample[key].zero_()
    history.fill_(1)
    assert (moved == 0).all()
    kept = HistoryStorage(episodes).get(EVERY)["next", "observation"]
    np.testing.assert_array_equal(kept.numpy(), arrays["next_observations"])


@pytest.mark.parametrize("dtype", [np.uint8, np.int8, np.int32, np.int64, bool])
@pytest.mark.parametrize("shape", [(), (2,)])  # indices, and one-hot
def test_discrete_actions_are_indices(dtype: type, shape: tuple[int, ...]) -> None:
    actions: NDArray = np.ones((6, *shape), dtype)
    ends = np.arange(6) == 5
    episodes = episodes_from_arrays(np.zeros((6, 3)), actions, np.ones(6), ends)
    action = HistoryStorage(episodes).get(EVERY)["action"]
    assert action.dtype == torch.int64
    assert (action == 1).all()
    padded = SequenceStorage(episodes, 3)[4]["action"]
    assert padded.dtype == torch.int64
    assert padded.reshape(3, -1).unique(dim=1).flatten().tolist() == [-10, 1, 1]


def sequence(
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
@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("with_next", [True, False])
def test_every_sequence(arrays: Transitions, num_frames: int, with_next: bool, full: bool) -> None:
    """Of finished episodes, whose final observations need not be known."""
    arrays = {name: array[:-1] for name, array in arrays.items()}
    if not with_next:
        del arrays["next_observations"]
    storage = SequenceStorage(
        episodes_from_arrays(**arrays), num_frames, return_scale=10.0, full=full
    )

    items = storage.get(EVERY)

    index = 0
    for start, stop in spans(arrays):
        for step in range(stop - start):
            first = min(step, max(0, stop - start - num_frames)) if full else step
            expected = sequence(arrays, start, stop, first, num_frames, 10.0)
            for name, values in expected.items():
                found = items[name][index].numpy()
                np.testing.assert_allclose(found, values, rtol=1e-6, atol=1e-6, err_msg=name)
            index += 1
    assert len(storage) == index < len(arrays["rewards"])
    assert (items["mask"].dtype, items["timestep"].dtype) == (torch.bool, torch.int64)


def test_parts_of_episodes_are_no_sequences() -> None:
    """Their returns to go would be those of the part, and their first step would be step 0."""
    ends = np.isin(np.arange(9), [2, 8])
    states, times = np.arange(9.0)[:, None], np.array([0, 1, 2, 3, 4, 9, 10, 11, 12])
    episodes = episodes_from_arrays(
        states, states, np.ones(9), ends, np.zeros(9, bool), timestamps=times, gaps="cut"
    )
    assert episodes.lengths.tolist() == [3, 2, 4]
    storage = SequenceStorage(episodes, 1)
    assert storage.get(EVERY)["observation"].flatten().tolist() == [0, 1, 2]
    rest, held_out = split_episodes(select_episodes(episodes, torch.tensor([0])), 0.3, seed=0)
    for part in (rest, held_out):
        with pytest.raises(DatasetError, match="nothing can be drawn"):
            SequenceStorage(part, 1)
    for fraction in (-1.0, 0.0, 1.0, 1.5):
        with pytest.raises(ValueError, match=r"fraction must be a probability in \(0, 1\)"):
            split_episodes(episodes, fraction, seed=0)


def test_returns_to_go_of_long_data_stay_exact() -> None:
    rewards = np.concatenate([np.full(200_000, 1e3), [0.1, 0.2], np.full(200_000, 1e3)])
    ends = np.zeros(len(rewards), dtype=bool)
    ends[[199_999, 200_001, -1]] = True
    states = np.zeros((len(rewards), 1))
    storage = SequenceStorage(episodes_from_arrays(states, states, rewards, ends), 2)
    item = storage[200_000]["return_to_go"].flatten() * 1000
    torch.testing.assert_close(item, torch.tensor([0.3, 0.2]), rtol=1e-5, atol=0)


@pytest.mark.parametrize("kind", [HistoryStorage, SequenceStorage])
def test_steps_are_drawn_uniformly_with_replacement(kind: Any) -> None:
    """So episodes are drawn by their length, and starts of sequences uniformly."""
    lengths = np.array([1, 4, 10])
    ends = np.isin(np.arange(15), lengths.cumsum() - 1)
    states = np.arange(15.0)[:, None]
    episodes = episodes_from_arrays(states, states, np.zeros(15), ends)
    batch = make_replay_buffer(kind(episodes, 1), 30_000).sample()
    counts = batch["observation"].flatten().long().bincount()
    assert len(counts) == 15
    assert ((counts - 2000).abs() < 5 * 2000**0.5).all()


def test_a_loaded_buffer_continues_with_the_same_batches(rolled: Transitions) -> None:
    def make(seed: int, **settings: Any) -> Any:
        episodes = episodes_from_arrays(**rolled)
        return make_replay_buffer(HistoryStorage(episodes, 2, **settings), 16, seed=seed)

    buffer, other = make(0), make(1)
    buffer.sample()
    torch.manual_seed(3)  # the global generator has no influence
    assert not (buffer.sample() == other.sample())["history"].all()
    other.load_state_dict(buffer.state_dict())
    for _ in range(3):
        assert (buffer.sample() == other.sample()).all()
    torch.manual_seed(4)
    assert (make(7).sample() == make(7).sample()).all()
    with pytest.raises(ValueError, match="The state was saved with"):
        make(0, time_limits="drop").load_state_dict(buffer.state_dict())


def test_the_buffer_cannot_be_written(rolled: Transitions) -> None:
    buffer = make_replay_buffer(HistoryStorage(episodes_from_arrays(**rolled)), 2)
    with pytest.raises(RuntimeError):
        buffer.extend(buffer.sample())
    with pytest.raises(RuntimeError, match="cannot be written"):
        buffer[0] = buffer.sample()
    with pytest.raises(RuntimeError):
        buffer.empty()


def test_nothing_to_draw(arrays: Transitions) -> None:
    one = {name: array[:1] for name, array in arrays.items()}
    one["timeouts"][:] = True
    with pytest.raises(DatasetError, match="nothing can be drawn from its 1 episodes"):
        HistoryStorage(episodes_from_arrays(**one), time_limits="drop")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_windows_gathered_on_a_gpu(rolled: Transitions) -> None:
    episodes = episodes_from_arrays(**rolled)
    here = HistoryStorage(episodes, 4, terminal_observations="zero")
    there = HistoryStorage(episodes.to("cuda"), 4, terminal_observations="zero")
    buffer = make_replay_buffer(there, 16)

    assert (there.get(EVERY).cpu() == here.get(EVERY)).all()
    state = buffer.state_dict()
    sample = buffer.sample()
    buffer.load_state_dict(state)
    assert sample["history"].device.type == "cuda"
    assert (buffer.sample() == sample).all()
