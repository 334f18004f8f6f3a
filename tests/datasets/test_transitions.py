"""How missing fields are replaced."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete

from tests.datasets.rollouts import Transitions, roll, spans
from torchrl_tit.datasets import (
    DatasetError,
    HistoryStorage,
    episodes_from_arrays,
    read_minari,
    task_spaces,
    write_hdf5,
    write_minari,
)
from torchrl_tit.datasets.checks import check_actions


def test_without_timeouts_an_episode_ends_where_the_next_observation_is_another(
    arrays: Transitions,
) -> None:
    timeouts = arrays.pop("timeouts")

    episodes = episodes_from_arrays(**arrays)

    steps = episodes.step_rows
    # After the last row, a time limit cannot be told from the end of the data.
    expected = timeouts & (np.arange(len(timeouts)) < len(timeouts) - 1)
    np.testing.assert_array_equal(episodes.rows["truncated"][steps, 0].numpy(), expected)
    np.testing.assert_array_equal(
        episodes.rows["observation"][steps + 1].numpy(), arrays["next_observations"]
    )


def test_without_timeouts_and_next_observations_the_time_limit_must_be_given(
    arrays: Transitions,
) -> None:
    timeouts = arrays.pop("timeouts")
    del arrays["next_observations"]

    episodes = episodes_from_arrays(**arrays, max_episode_steps=15)

    truncated = episodes.rows["truncated"][episodes.step_rows, 0].numpy()
    np.testing.assert_array_equal(truncated, timeouts & ~arrays["terminals"])


def test_no_end_hints_at_the_time_limit(arrays: Transitions) -> None:
    del arrays["timeouts"], arrays["next_observations"]
    arrays["terminals"][:] = False
    with pytest.raises(DatasetError, match=r"no episode ends.*give max_episode_steps"):
        episodes_from_arrays(**arrays)


def test_without_next_observations_those_of_time_limits_are_never_drawn(
    arrays: Transitions,
) -> None:
    following = arrays.pop("next_observations")

    episodes = episodes_from_arrays(**arrays)
    sample = HistoryStorage(episodes).get(slice(None))

    drawn = ~arrays["timeouts"] | arrays["terminals"]
    expected = np.where(arrays["terminals"][:, None], 0, following)[drawn]
    np.testing.assert_array_equal(sample["observation"].numpy(), arrays["observations"][drawn])
    np.testing.assert_array_equal(sample["next", "observation"].numpy(), expected)
    # Their rewards still count.
    returns = [arrays["rewards"][a:b].sum(dtype=np.float64) for a, b in spans(arrays)]
    np.testing.assert_allclose(episodes.returns.numpy(), returns)
    with pytest.raises(DatasetError, match=r"episode \d+ was truncated and its final observation"):
        write_hdf5(episodes, "never-written.hdf5")


def test_a_trailing_step_without_a_next_observation_is_never_drawn(arrays: Transitions) -> None:
    del arrays["next_observations"]
    start, stop = spans(arrays)[-1]
    cut = {name: array[: stop - 1] for name, array in arrays.items()}
    whole = {name: array[:start] for name, array in arrays.items()}

    kept = HistoryStorage(episodes_from_arrays(**cut), unfinished="keep")

    assert len(kept) == len(HistoryStorage(episodes_from_arrays(**whole))) + stop - 1 - start - 1


def test_images_and_discrete_actions_stay_integers() -> None:
    frames = np.random.default_rng(0).integers(0, 256, (6, 8, 8), dtype=np.uint8)
    ends = np.array([False, False, True] * 2)

    sample = HistoryStorage(
        episodes_from_arrays(frames, np.arange(6, dtype=np.int32), np.ones(6, int), ends), 2
    ).get(slice(None))

    assert sample["history"].dtype == torch.uint8
    assert sample["history"].shape == (6, 2, 8, 8)
    assert sample["action"].tolist() == [0, 1, 2, 3, 4, 5]
    assert sample["next", "reward"].dtype == torch.float32


def test_discrete_actions_in_a_column_of_their_own(tmp_path: Path) -> None:
    rolled = roll(task="CartPole-v1", max_episode_steps=20)
    column = {**rolled, "actions": rolled["actions"][:, None]}
    task = task_spaces("CartPole-v1")
    expected = episodes_from_arrays(**rolled, task=task)
    assert expected.rows["action"].ndim == 1
    assert (episodes_from_arrays(**column, task=task).rows == expected.rows).all()
    without_task = episodes_from_arrays(**column)
    assert without_task.rows["action"].shape[1:] == (1,)
    write_minari(without_task, tmp_path / "column-v0")
    assert (read_minari(tmp_path / "column-v0", task=task).rows == expected.rows).all()


def test_other_byte_orders_are_read(arrays: Transitions) -> None:
    expected = episodes_from_arrays(**arrays).rows
    swapped = {n: a.astype(a.dtype.newbyteorder(">")) for n, a in arrays.items()}
    assert (episodes_from_arrays(**swapped).rows == expected).all()


def test_a_gap_is_refused_or_ends_the_episode(arrays: Transitions) -> None:
    start, stop = max(spans(arrays), key=lambda span: span[1] - span[0])
    row = (start + stop) // 2
    arrays["next_observations"][row, 4] += 1

    with pytest.raises(DatasetError, match=f"'next_observations', row {row}: .* gaps=\"cut\""):
        episodes_from_arrays(**arrays)
    episodes = episodes_from_arrays(**arrays, gaps="cut")

    arrays["timeouts"][row] = True
    assert (episodes.rows == episodes_from_arrays(**arrays).rows).all()
    assert (row + 1 - start) in episodes.lengths


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_episode_steps": 0}, "max_episode_steps must be at least 1, not 0"),
        ({"gaps": "cutt"}, "field 'gaps' is 'cutt', not one of"),
    ],
)
def test_wrong_settings(arrays: Transitions, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        episodes_from_arrays(**arrays, **settings)


def test_bounds_are_those_of_the_entry_that_is_wrong() -> None:
    space = Box(np.array([-1.0, 0.0], np.float32), np.ones(2, np.float32))
    message = "row 6: is -0.5, but the task's actions range from 0.0 to 1.0"
    with pytest.raises(DatasetError, match=message):
        check_actions("a.hdf5", np.array([[-0.5, 0.5], [0.5, -0.5]]), space, first_row=5)
    with pytest.raises(DatasetError, match="row 1: is 3, but the task's actions range from 0 to 2"):
        check_actions("a.hdf5", np.array([[2], [3]]), Discrete(3))
