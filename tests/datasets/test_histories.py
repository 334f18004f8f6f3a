"""Windows gathered from stored episodes equal those of History in the environment."""

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.envs import GymEnv, TransformedEnv

from tests.datasets.rollouts import Transitions, spans
from tests.transforms.streams import StreamEnv
from torchrl_tit.datasets import (
    DatasetError,
    Episodes,
    HistoryStorage,
    episodes_from_arrays,
    make_replay_buffer,
)
from torchrl_tit.transforms import History


def store(stream: TensorDictBase) -> Episodes:
    """Stores a rollout of an environment as episodes, without histories."""
    following = stream["next"]
    ended = following["done"][:, 0]
    terminals = following["terminated"][:, 0]
    return episodes_from_arrays(
        stream["observation"],
        stream["action"],
        following["reward"],
        terminals,
        ended & ~terminals,
        following["observation"],
    )


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("num_frames", [1, 2, 4, 20])
def test_windows_are_those_of_catframes(num_frames: int, padding: Any) -> None:
    env = GymEnv("Hopper-v5", max_episode_steps=12)
    env = TransformedEnv(env, History(num_frames, padding=padding))
    env.set_seed(0)
    stream = env.rollout(150, break_when_any_done=False)
    assert stream["next", "terminated"].any()
    assert stream["next", "truncated"].any()

    sample = HistoryStorage(store(stream), num_frames, padding=padding, unfinished="keep").get(
        slice(None)
    )

    assert sample.batch_size == (150,)
    for key in sample.exclude("episode").keys(True, True):
        torch.testing.assert_close(sample[key], stream[key].to(sample[key].dtype), rtol=0, atol=0)


@pytest.mark.parametrize("padding", ["same", "constant"])
def test_windows_of_images_are_those_of_catframes(padding: Any) -> None:
    env = TransformedEnv(
        StreamEnv((), (6, 5), torch.uint8), History(4, observation_ndim=2, padding=padding)
    )
    stream = env.rollout(100, break_when_any_done=False)

    sample = HistoryStorage(store(stream), 4, padding=padding, unfinished="keep").get(slice(None))

    assert sample["history"].dtype == torch.uint8
    for key in ("history", ("next", "history"), "observation", ("next", "observation")):
        torch.testing.assert_close(sample[key], stream[key], rtol=0, atol=0)


def test_settings_of_d3rlpy_1(arrays: Transitions) -> None:
    arrays["terminals"][arrays["timeouts"].argmax()] = True  # both at once count as terminal
    episodes = episodes_from_arrays(**arrays)

    sample = HistoryStorage(episodes, 3, time_limits="drop", terminal_observations="zero").get(
        slice(None)
    )

    drawn = ~arrays["timeouts"] | arrays["terminals"]
    terminals = arrays["terminals"][drawn]
    following = arrays["next_observations"][drawn]
    np.testing.assert_array_equal(sample["observation"].numpy(), arrays["observations"][drawn])
    np.testing.assert_array_equal(
        sample["next", "history"][:, -1].numpy(), np.where(terminals[:, None], 0, following)
    )
    torch.testing.assert_close(sample["next", "history"][:, -1], sample["next", "observation"])
    torch.testing.assert_close(sample["next", "history"][:, :-1], sample["history"][:, 1:])
    # The data themselves have not changed.
    torch.testing.assert_close(
        HistoryStorage(episodes).get(slice(None))["next", "observation"].numpy(),
        arrays["next_observations"],
    )


@pytest.mark.parametrize("num_frames", [1, 3])
def test_indices_of_every_kind(rolled: Transitions, num_frames: int) -> None:
    storage = HistoryStorage(episodes_from_arrays(**rolled), num_frames)
    everything = storage.get(slice(None))
    grid = torch.tensor([[0, 5, 2], [7, -1, 40]])

    assert (storage[grid] == everything[grid]).all()
    assert (storage[[3, 4]] == everything[[3, 4]]).all()
    assert (storage[-2] == everything[-2]).all()
    assert storage[5]["history"].shape == (num_frames, 11)
    assert (storage[10:20:3] == everything[10:20:3]).all()
    assert storage[:0].batch_size == (0,)
    for wrong in (len(storage), -len(storage) - 1):
        with pytest.raises(IndexError, match="out of bounds"):
            storage[wrong]


def test_samples_can_be_changed_without_changing_the_data(rolled: Transitions) -> None:
    storage = HistoryStorage(episodes_from_arrays(**rolled), 3)
    sample = storage[:10]
    for key in sample.keys(True, True):
        sample[key].zero_()
    assert (sample["history"] == 0).all()
    sample["history"].fill_(1)
    assert (sample["next", "history"] == 0).all()
    np.testing.assert_array_equal(storage[:10]["observation"].numpy(), rolled["observations"][:10])


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.int64])
def test_discrete_actions_are_indices(dtype: type) -> None:
    ends = np.arange(4) == 3
    actions: NDArray = np.array([3, 1, 0, 2]).astype(dtype)
    episodes = episodes_from_arrays(np.zeros((4, 2)), actions, np.ones(4), ends)
    action = HistoryStorage(episodes).get(slice(None))["action"]
    assert action.dtype == torch.int64
    assert action.tolist() == [3, 1, 0, 2]


def test_drawing_is_uniform_with_replacement(arrays: Transitions) -> None:
    start, stop = spans(arrays)[2]
    few = {name: array[start:stop] for name, array in arrays.items()}
    few["rewards"] = np.arange(stop - start)
    buffer = make_replay_buffer(HistoryStorage(episodes_from_arrays(**few)), 20_000)
    counts = buffer.sample()["next", "reward"].flatten().long().bincount()
    expected = 20_000 / (stop - start)
    assert len(counts) == stop - start
    assert ((counts - expected).abs() < 5 * expected**0.5).all()


def test_a_loaded_buffer_continues_with_the_same_batches(rolled: Transitions) -> None:
    def make(seed: int) -> Any:
        return make_replay_buffer(HistoryStorage(episodes_from_arrays(**rolled), 2), 16, seed=seed)

    buffer, other = make(0), make(1)
    buffer.sample()
    torch.manual_seed(3)  # the global generator has no influence
    assert not (buffer.sample() == other.sample())["history"].all()
    other.load_state_dict(buffer.state_dict())
    for _ in range(3):
        assert (buffer.sample() == other.sample()).all()
    torch.manual_seed(4)
    assert (make(7).sample() == make(7).sample()).all()


def test_a_state_of_other_data_is_refused(rolled: Transitions) -> None:
    episodes = episodes_from_arrays(**rolled)
    state = make_replay_buffer(HistoryStorage(episodes), 2).state_dict()
    other = make_replay_buffer(HistoryStorage(episodes, time_limits="drop"), 2)
    with pytest.raises(ValueError, match="The state was saved with"):
        other.load_state_dict(state)


def test_the_buffer_cannot_be_written(rolled: Transitions) -> None:
    buffer = make_replay_buffer(HistoryStorage(episodes_from_arrays(**rolled)), 2)
    with pytest.raises(RuntimeError):
        buffer.extend(buffer.sample())
    with pytest.raises(RuntimeError, match="cannot be written"):
        buffer[0] = buffer.sample()
    with pytest.raises(RuntimeError):
        buffer.empty()
    with pytest.raises(ValueError, match="batch_size must be at least 1, not 0"):
        make_replay_buffer(buffer.storage, 0)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_frames": 0}, "num_frames must be at least 1"),
        ({"padding": "zeros"}, "field 'padding' is 'zeros', not one of"),
        ({"time_limits": "lose"}, "'time_limits' is 'lose', not one of"),
        ({"terminal_observations": "drop"}, "'terminal_observations' is 'drop', not one of"),
        ({"unfinished": True}, "unfinished"),
    ],
)
def test_wrong_settings(rolled: Transitions, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        HistoryStorage(episodes_from_arrays(**rolled), **settings)


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

    assert (there.get(slice(None)).cpu() == here.get(slice(None))).all()
    state = buffer.state_dict()
    sample = buffer.sample()
    buffer.load_state_dict(state)
    assert sample["history"].device.type == "cuda"
    assert (buffer.sample() == sample).all()
