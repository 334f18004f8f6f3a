"""Transitions in arrays and HDF5 files: read exactly, completed by rules, refused by name."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Discrete, MultiBinary, MultiDiscrete

from tests.datasets.hostile import nest
from tests.datasets.rollouts import NAMES, Transitions, roll, spans, write
from torchrl_tit.datasets import (
    DatasetError,
    Episodes,
    HistoryStorage,
    TaskSpaces,
    episodes,
    episodes_from_arrays,
    join_episodes,
    load_episodes,
    read_hdf5,
    read_minari,
    select_episodes,
    task_spaces,
    write_hdf5,
    write_minari,
)
from torchrl_tit.datasets.checks import check_actions
from torchrl_tit.datasets.transitions import episodes_from_transitions


def fields_of(data: Episodes) -> Transitions:
    """The transitions in the layout of D4RL."""
    steps = data.step_rows
    values = [data.rows[name][steps] for name in ("observation", "action")]
    values += [data.rows[name][steps, 0] for name in ("reward", "terminated", "truncated")]
    values.append(data.rows["observation"][steps + 1])
    return {name: x.numpy() for name, x in zip(NAMES, values, strict=True)}


def assert_same(found: Transitions, expected: Transitions) -> None:
    for name in expected:
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)
        assert found[name].dtype == expected[name].dtype


@pytest.mark.parametrize("chunk_bytes", [1, 500, 2**24])
def test_every_field_is_that_of_the_file(
    tmp_path: Path, rolled: Transitions, monkeypatch: pytest.MonkeyPatch, chunk_bytes: int
) -> None:
    monkeypatch.setattr(episodes, "CHUNK_BYTES", chunk_bytes)
    path = write(tmp_path / "a.hdf5", {**rolled, "infos/qpos": rolled["rewards"]}, policy="random")

    data = load_episodes(path, task="Hopper-v5")

    assert_same(fields_of(data), rolled)
    assert data.attributes == {"policy": "random"}
    assert data.left_out == ("infos/qpos",)
    expected = spans(rolled)
    assert data.lengths.tolist() == [stop - start for start, stop in expected]
    returns = [rolled["rewards"][start:stop].sum(dtype=np.float64) for start, stop in expected]
    np.testing.assert_allclose(data.returns.numpy(), returns, rtol=1e-12)
    ends = [rolled["terminals"][stop - 1] for _, stop in expected]
    np.testing.assert_array_equal(data.terminated.numpy(), ends)


def test_dtypes_and_layouts(arrays: Transitions) -> None:
    """Floats become float32 unless they are to be kept; columns and byte orders do not matter."""
    expected = episodes_from_arrays(**arrays).rows
    doubles = {n: a.astype(np.float64) if a.dtype != bool else a for n, a in arrays.items()}
    doubles["terminals"] = doubles["terminals"].astype(np.uint8)
    doubles["rewards"] = doubles["rewards"][:, None]
    swapped = {n: a.astype(a.dtype.newbyteorder(">")) for n, a in arrays.items()}
    for given in (doubles, swapped):
        rows = episodes_from_arrays(**given).rows
        assert (rows == expected).all()
        assert {n: x.dtype for n, x in rows.items()} == {n: x.dtype for n, x in expected.items()}
    kept = episodes_from_arrays(**doubles, dtype=None).rows
    assert {kept[n].dtype for n in ("observation", "action", "reward")} == {torch.float64}

    frames = np.random.default_rng(0).integers(0, 256, (6, 8, 8), dtype=np.uint8)
    ends = np.array([False, False, True] * 2)
    images = episodes_from_arrays(frames, np.arange(6, dtype=np.int32), np.ones(6, int), ends)
    dtypes = [images.rows[name].dtype for name in ("observation", "action", "reward")]
    assert dtypes == [torch.uint8, torch.int64, torch.float32]


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


def test_a_trailing_unfinished_episode_is_separate(arrays: Transitions) -> None:
    start, stop = spans(arrays)[-1]
    cut = {name: array[: stop - 1] for name, array in arrays.items()}
    whole = {name: array[:start] for name, array in arrays.items()}

    data = episodes_from_arrays(**cut)

    assert_same(fields_of(data), cut)
    assert data.finished.tolist() == [True] * (len(spans(arrays)) - 1) + [False]
    assert len(HistoryStorage(data)) == start
    assert len(HistoryStorage(data, unfinished="keep")) == stop - 1
    mean, std, _ = data.observation_statistics()  # of finished episodes
    observations = whole["observations"].astype(np.float64)
    np.testing.assert_allclose(mean, observations.mean(0), rtol=1e-6)
    np.testing.assert_allclose(std, observations.std(0), rtol=1e-6)
    with pytest.raises(DatasetError, match="no observations of finished episodes"):
        select_episodes(data, torch.tensor([len(data.lengths) - 1])).observation_statistics()
    mean, _, count = data.observation_statistics(unfinished="keep")
    assert count == len(cut["observations"])
    observations = cut["observations"].astype(np.float64)
    np.testing.assert_allclose(mean, observations.mean(0), rtol=1e-6)
    # Without next observations, its last step is never drawn.
    del cut["next_observations"], whole["next_observations"]
    kept = HistoryStorage(episodes_from_arrays(**cut), unfinished="keep")
    assert len(kept) == len(HistoryStorage(episodes_from_arrays(**whole))) + stop - start - 2


def test_without_timeouts(arrays: Transitions) -> None:
    """An episode ends where the next observation is another, or after a number of steps."""
    timeouts, following = arrays.pop("timeouts"), arrays["next_observations"]

    data = fields_of(episodes_from_arrays(**arrays))

    # After the last row, a time limit cannot be told from the end of the data.
    expected = timeouts & (np.arange(len(timeouts)) < len(timeouts) - 1)
    np.testing.assert_array_equal(data["timeouts"], expected)
    np.testing.assert_array_equal(data["next_observations"], following)
    del arrays["next_observations"]
    data = fields_of(episodes_from_arrays(**arrays, max_episode_steps=15))
    np.testing.assert_array_equal(data["timeouts"], timeouts & ~arrays["terminals"])
    marked = {**arrays, "timeouts": timeouts}
    np.testing.assert_array_equal(
        fields_of(episodes_from_arrays(**marked, max_episode_steps=15))["timeouts"], timeouts
    )
    with pytest.raises(DatasetError, match=r"an episode of 15 steps, but max_episode_steps is 14"):
        episodes_from_arrays(**marked, max_episode_steps=14)
    arrays["terminals"][:] = False
    with pytest.raises(DatasetError, match=r"no episode ends.*give max_episode_steps"):
        episodes_from_arrays(**arrays)


def test_without_next_observations_those_of_time_limits_are_never_drawn(
    arrays: Transitions, tmp_path: Path
) -> None:
    whole = episodes_from_arrays(**arrays)
    following = arrays.pop("next_observations")

    data = episodes_from_arrays(**arrays)
    sample = HistoryStorage(data).get(slice(None))

    drawn = ~arrays["timeouts"] | arrays["terminals"]
    expected = np.where(arrays["terminals"][:, None], 0, following)[drawn]
    np.testing.assert_array_equal(sample["observation"].numpy(), arrays["observations"][drawn])
    np.testing.assert_array_equal(sample["next", "observation"].numpy(), expected)
    # Their rewards still count.
    returns = [arrays["rewards"][a:b].sum(dtype=np.float64) for a, b in spans(arrays)]
    np.testing.assert_allclose(data.returns.numpy(), returns)
    # They are written without any, and come back the same.
    for name, part in (("a", data), ("b", select_episodes(data, data.terminated.nonzero()[:, 0]))):
        write_hdf5(part, tmp_path / f"{name}.hdf5")
        again = read_hdf5(tmp_path / f"{name}.hdf5")
        assert (again.rows == part.rows).all()
        assert not again.final_known.any()
    with pytest.raises(DatasetError, match=r"episode \d+ was truncated and its final observation"):
        write_hdf5(join_episodes([data, whole]), tmp_path / "never-written.hdf5")


def test_timestamps_are_checked_within_episodes(arrays: Transitions, tmp_path: Path) -> None:
    start, stop = max(spans(arrays), key=lambda span: span[1] - span[0])
    times = np.arange(len(arrays["rewards"])) * 0.01
    times[stop:] -= times[stop]  # the clock starts again
    data = read_hdf5(write(tmp_path / "a.hdf5", {**arrays, "timestamps": times}))
    assert (data.rows == episodes_from_arrays(**arrays).rows).all()
    assert data.left_out == ("timestamps",)
    for bad in (times[start] - 1, np.nan):
        times[start + 1] = bad
        message = f"'timestamps', row {start + 1}: is {bad} after {times[start]}, within an episode"
        with pytest.raises(DatasetError, match=re.escape(message)):
            episodes_from_arrays(**arrays, timestamps=times)
    with pytest.raises(DatasetError, match=r"'timestamps': must be \d+ numbers"):
        episodes_from_arrays(**arrays, timestamps=times[1:])


def test_a_pause_is_no_end_of_an_episode() -> None:
    """Also in data that do not mark time limits, where only a gap is one."""
    states = np.arange(20.0)[:, None]
    fields = {"observations": states, "actions": states, "rewards": np.ones(20)}
    times = np.arange(20.0) + 5 * (np.arange(20) > 2)
    ends = np.isin(np.arange(20), [9, 19])
    data = episodes_from_arrays(**fields, terminals=ends, timestamps=times, gaps="cut")
    assert data.lengths.tolist() == [3, 7, 10]
    assert data.cut.tolist() == [True, True, False]
    limited = episodes_from_arrays(
        **fields, terminals=ends & False, timestamps=times, gaps="cut", max_episode_steps=10
    )
    assert limited.lengths.tolist() == [3, 7, 10]
    assert limited.cut.tolist() == [True, True, False]


def test_a_gap_is_refused_or_ends_the_episode(arrays: Transitions) -> None:
    start, stop = max(spans(arrays), key=lambda span: span[1] - span[0])
    row = (start + stop) // 2
    arrays["next_observations"][row, 4] += 1

    with pytest.raises(DatasetError, match=f"'next_observations', row {row}: .* gaps=\"cut\""):
        episodes_from_arrays(**arrays)
    data = episodes_from_arrays(**arrays, gaps="cut")
    pieces = data.cut.nonzero().flatten().tolist()
    assert data.lengths[pieces].tolist() == [row + 1 - start, stop - row - 1]
    whole = [i for i in range(len(data.lengths)) if i not in pieces and data.finished[i]]
    assert data.whole.tolist() == whole
    single = {name: array[start:stop] for name, array in arrays.items()}
    with pytest.raises(
        DatasetError, match="has no whole episode, only unfinished ones or parts of others"
    ):
        _ = episodes_from_arrays(**single, gaps="cut").whole
    del single["timeouts"]  # then gaps are where episodes end
    assert len(episodes_from_arrays(**single, gaps="cut", max_episode_steps=10_000).whole)

    arrays["timeouts"][row] = True
    marked = episodes_from_arrays(**arrays)
    assert not marked.cut.any()
    expected = marked.rows
    assert (data.rows == expected).all()
    arrays["timeouts"][row] = False
    arrays["next_observations"][row, 4] -= 1
    times = np.arange(len(arrays["rewards"])) * 0.01
    times[row + 1 :] += 0.01  # a step was not recorded
    with pytest.raises(DatasetError, match=f"'timestamps', row {row + 1}: .* interval, 0.01, or"):
        episodes_from_arrays(**arrays, timestamps=times)
    arrays["next_observations"][row, 4] += 1
    data = episodes_from_arrays(**arrays, timestamps=times, gaps="cut")
    assert (data.rows == expected).all()
    assert data.cut.nonzero().flatten().tolist() == pieces


def test_writing_is_lossless_and_never_overwrites(tmp_path: Path, rolled: Transitions) -> None:
    unfinished = {name: array[:-1] for name, array in rolled.items()}
    path = write(tmp_path / "a.hdf5", unfinished, policy="random")

    write_hdf5(read_hdf5(path, dtype=None), tmp_path / "b.hdf5")

    with h5py.File(path) as before, h5py.File(tmp_path / "b.hdf5") as after:
        assert dict(before.attrs) == dict(after.attrs)
        assert_same({n: after[n][:] for n in after}, {n: before[n][:] for n in before})
        assert set(before) == set(after)
    content = path.read_bytes()
    with pytest.raises(FileExistsError, match="exists already"):
        write_hdf5(read_hdf5(path), path)
    assert path.read_bytes() == content


def test_what_is_large_and_not_needed_is_left_out(tmp_path: Path, rolled: Transitions) -> None:
    path = write(tmp_path / "a.hdf5", rolled, env_id="Hopper-v5")
    with h5py.File(path, "a") as file:
        del file["rewards"]
        file["data/rewards"] = rolled["rewards"]
        file["rewards"] = file["data/rewards"]  # a hard link is a field of each name
        file["elsewhere"] = h5py.SoftLink("data")
    assert read_hdf5(path).left_out == ("data/rewards", "elsewhere")
    with h5py.File(path, "a") as file:
        file.attrs["authors"] = ["A", "B"]
        file.attrs["names"] = ["walk"] * 1000
        file.attrs["none"] = h5py.Empty("f")
        file.attrs["long"] = np.longdouble(0.5)
        nest(file.create_group("infos"))

    data = read_hdf5(path)

    assert data.attributes == {"env_id": "Hopper-v5", "authors": ["A", "B"], "long": 0.5}
    omitted = ("and others", "attribute names", "attribute none", "data/rewards", "elsewhere")
    assert data.left_out == omitted


def test_attributes_of_fields_are_said_to_be_left_out(tmp_path: Path, rolled: Transitions) -> None:
    path = write(tmp_path / "a.hdf5", rolled)
    with h5py.File(path, "a") as file:
        file["observations"].attrs["unit"] = "m"
    assert read_hdf5(path).left_out == ("attributes of observations",)


def _at(name: str, place: Any, value: float) -> Callable[[Transitions], Any]:
    return lambda arrays: arrays[name].__setitem__(place, value)


def _as(**changes: Callable[[Transitions], Any]) -> Callable[[Transitions], None]:
    return lambda arrays: arrays.update({n: change(arrays) for n, change in changes.items()})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a.pop("actions"), "'actions': is missing; there is next_observations, observa"),
        (_as(rewards=lambda a: a["rewards"][:-1]), r"'rewards': has \d+ rows, but 'observations' "),
        (_at("rewards", 7, np.nan), "'rewards', row 7: is nan"),
        (_at("observations", (8, 2), -np.inf), "'observations', row 8: is -inf"),
        (_as(rewards=lambda a: a["rewards"] + np.eye(1, len(a["rewards"]), 7)[0] * 1e300),
         r"'rewards', row 7: is 1e\+300, but all values must be finite as float32"),
        (_at("next_observations", (9, 0), np.nan), "'next_observations', row 9: is nan"),
        (_at("actions", (123, 1), 1.01), r"'actions', row 123: is 1.0\d*, but the task's actions"),
        (_as(terminals=lambda a: a["rewards"] * 0 + 3), "'terminals', row 0: is 3.0, but must be "),
        (_as(rewards=lambda a: a["actions"]), r"'rewards': one row has the shape \[3\]"),
        (_as(observations=lambda a: a["rewards"]), "'observations': one row is one number"),
        (_as(actions=lambda a: a["actions"].astype("S5")), r"'actions': has the dtype \|S5, but m"),
        (_as(actions=lambda a: a["actions"][:, :2]),
         r"'actions': one row has the shape \[2\], but in Hopper-v5"),
        (_as(next_observations=lambda a: a["actions"]),
         r"'next_observations': one row has the shape \[3\]"),
        (_at("next_observations", (3, 0), 9),
         "'next_observations', row 3: is not the observation of the next row"),
        (_as(**{n: lambda a, n=n: a[n][:0] for n in NAMES}), "'observations': has no rows"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("chunk_bytes", [64, 2**22])
def test_errors_name_file_field_and_row(
    tmp_path: Path,
    arrays: Transitions,
    monkeypatch: pytest.MonkeyPatch,
    chunk_bytes: int,
    change: Callable[[Transitions], Any],
    message: str,
) -> None:
    monkeypatch.setattr(episodes, "CHUNK_BYTES", chunk_bytes)
    change(arrays)
    path = write(tmp_path / "bad.hdf5", arrays)
    with pytest.raises(DatasetError, match=f"^{re.escape(str(path))}: field {message}"):
        read_hdf5(path, task=task_spaces("Hopper-v5"))


def test_damaged_and_other_files(tmp_path: Path, rolled: Transitions) -> None:
    path = tmp_path / "a.hdf5"
    with h5py.File(path, "w") as file:
        for name, array in rolled.items():
            file.create_dataset(name, data=array, chunks=True, fletcher32=True)
        offset = file["rewards"].id.get_chunk_info(0).byte_offset
    content = bytearray(path.read_bytes())
    content[offset] ^= 255
    path.write_bytes(content)
    with pytest.raises(DatasetError, match="field 'rewards', row 0: rows from here on cannot be"):
        load_episodes(path)
    path.write_bytes(content[:-1000])
    with pytest.raises(DatasetError, match=r"a\.hdf5: is not a whole HDF5 file .*truncated"):
        load_episodes(path)
    with pytest.raises(FileNotFoundError, match=r"b\.hdf5"):
        load_episodes(tmp_path / "b.hdf5")
    with pytest.raises(ValueError, match="'hopper' is not a data set"):
        load_episodes("hopper")
    with pytest.raises(ValueError, match=r"did you mean hopper-medium-v.*Minari has"):
        load_episodes("hopper-medium-v9")
    with h5py.File(tmp_path / "c.hdf5", "w") as file:
        file["observations/state"] = [1.0]
    with pytest.raises(DatasetError, match="'observations': is missing; there is observations/st"):
        load_episodes(tmp_path / "c.hdf5")


def test_a_task_of_the_same_sizes(tmp_path: Path) -> None:
    rolled = roll(task="Walker2d-v5", max_episode_steps=10)
    path = write(tmp_path / "a.hdf5", rolled, env_id="Walker2d-v5")
    read = read_hdf5(path, task=task_spaces("Walker2d-v4"))
    assert read.num_transitions == len(rolled["rewards"])
    message = r"a.hdf5: field 'env_id': is Walker2d-v5, but the task is HalfCheetah-v5"
    with pytest.raises(DatasetError, match=message):
        load_episodes(path, task="HalfCheetah-v5")
    with pytest.raises(DatasetError, match="is walker2d, but the task is HalfCheetah-v5"):
        load_episodes("walker2d-medium-v0", task="HalfCheetah-v5", cache_dir=tmp_path / "none")
    assert not (tmp_path / "none").exists()  # nothing was downloaded


def test_bytes_stay_bytes() -> None:
    """Networks divide bytes by 255: data in another dtype would be of another scale."""
    frames, ends = np.full((2, 8, 8), 255, np.uint8), [False, True]
    task = TaskSpaces(Box(0, 255, (8, 8), np.uint8), Discrete(2), "a game")
    episodes_from_arrays(frames, np.zeros(2, int), np.ones(2), ends, task=task)
    floats = task._replace(observation=Box(0, 255, (8, 8)))
    for wrong, other in ((np.float32(frames), task), (frames, floats)):
        with pytest.raises(DatasetError, match=r"'observations': is .*, but in a game it is"):
            episodes_from_arrays(wrong, np.zeros(2, int), np.ones(2), ends, task=other)


def test_bounds_are_those_of_the_entry_that_is_wrong() -> None:
    space = Box(np.array([-1.0, 0.0], np.float32), np.ones(2, np.float32))
    message = "row 6: is -0.5, but the task's actions range from 0.0 to 1.0"
    with pytest.raises(DatasetError, match=message):
        check_actions("a.hdf5", np.array([[-0.5, 0.5], [0.5, -0.5]]), space, first_row=5)
    with pytest.raises(DatasetError, match="row 1: is 3, but the task's actions range from 0 to 2"):
        check_actions("a.hdf5", np.array([[2], [3]]), Discrete(3))


@pytest.mark.parametrize(
    ("space", "actions", "message"),
    [
        (MultiBinary(2), [[0, 1], [2, 1]], "row 1: is 2, .* from 0 to 1 here"),
        (MultiBinary((1, 2)), [[[0, 1]], [[-1, 1]]], "row 1: is -1, .* from 0 to 1 here"),
        (MultiDiscrete([2, 3]), [[1, 2], [2, 0]], "row 1: is 2, .* from 0 to 1 here"),
        (MultiDiscrete([2, 3], start=[0, 4]), [[1, 6], [0, 3]], "row 1: is 3, .* from 4 to 6 here"),
    ],
)
def test_each_of_several_choices_lies_in_its_range(space: Any, actions: Any, message: str) -> None:
    """A switch that is 2 would have any likelihood."""
    check_actions("a.hdf5", np.array(actions[:1]), space)
    with pytest.raises(DatasetError, match=message):
        check_actions("a.hdf5", np.array(actions), space)


def test_selected_and_joined_episodes_keep_their_rows(arrays: Transitions) -> None:
    data = episodes_from_arrays(**arrays)
    order = [5, 0, 0, 2]
    selected = select_episodes(data, torch.tensor(order))
    found = fields_of(selected)
    rows = np.concatenate([np.arange(*spans(arrays)[number]) for number in order])
    assert_same(found, {name: array[rows] for name, array in arrays.items()})
    assert torch.equal(selected.returns, data.returns[order])
    parts = [select_episodes(data, torch.tensor(part)) for part in ([5, 0], [0, 2])]
    joined = join_episodes(parts)
    assert (joined.rows == selected.rows).all()
    assert torch.equal(joined.lengths, selected.lengths)


@pytest.mark.parametrize("lengths", [[2, 2], [3, 5], [6, 0]])
def test_lengths_that_are_not_those_of_the_rows_are_refused(lengths: list[int]) -> None:
    zeros, flags = np.zeros((6, 1)), np.zeros(6, bool)
    settings: dict[str, Any] = {"lengths": np.array(lengths), "source": "a.hdf5"}
    fields = {"observations": zeros, "actions": zeros, "rewards": zeros[:, 0], "terminals": flags}
    with pytest.raises(DatasetError, match="lengths must be positive, add up to the 6 rows, and"):
        episodes_from_transitions({**fields, "timeouts": flags}, **settings)
    with pytest.raises(DatasetError, match="and come with 'timeouts'"):
        episodes_from_transitions(fields, source="a.hdf5", lengths=np.array([2, 4]))
