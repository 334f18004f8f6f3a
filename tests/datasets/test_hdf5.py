"""HDF5 files: fields are read exactly, and errors name the file, field and row."""

import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from tests.datasets.hostile import nest
from tests.datasets.rollouts import Transitions, roll, spans, write
from torchrl_tit.datasets import (
    DatasetError,
    Episodes,
    HistoryStorage,
    load_episodes,
    read_hdf5,
    task_spaces,
    write_hdf5,
)
from torchrl_tit.datasets import episodes as episodes_module


def assert_same_fields(episodes: Episodes, arrays: Transitions) -> None:
    steps = episodes.step_rows
    fields = {
        "observations": episodes.rows["observation"][steps],
        "actions": episodes.rows["action"][steps],
        "rewards": episodes.rows["reward"][steps, 0],
        "terminals": episodes.rows["terminated"][steps, 0],
        "timeouts": episodes.rows["truncated"][steps, 0],
        "next_observations": episodes.rows["observation"][steps + 1],
    }
    for name, values in fields.items():
        np.testing.assert_array_equal(values.numpy(), arrays[name], err_msg=name)


@pytest.mark.parametrize("chunk_bytes", [1, 500, 2**24])
def test_every_field_is_that_of_the_file(
    tmp_path: Path, rolled: Transitions, monkeypatch: pytest.MonkeyPatch, chunk_bytes: int
) -> None:
    monkeypatch.setattr(episodes_module, "CHUNK_BYTES", chunk_bytes)
    path = write(tmp_path / "a.hdf5", rolled, env_id="Hopper-v5")

    episodes = load_episodes(path, task="Hopper-v5")

    assert_same_fields(episodes, rolled)
    assert episodes.attributes == {"env_id": "Hopper-v5"}
    expected = spans(rolled)
    assert episodes.lengths.tolist() == [stop - start for start, stop in expected]
    returns = [rolled["rewards"][start:stop].sum(dtype=np.float64) for start, stop in expected]
    np.testing.assert_allclose(episodes.returns.numpy(), returns, rtol=1e-12)
    np.testing.assert_array_equal(
        episodes.terminated.numpy(), [rolled["terminals"][stop - 1] for _, stop in expected]
    )


def test_samples_are_rows_of_the_file(tmp_path: Path, rolled: Transitions) -> None:
    storage = HistoryStorage(read_hdf5(write(tmp_path / "a.hdf5", rolled)))

    sample = storage.get(slice(None))

    pairs = {
        "observations": sample["observation"],
        "actions": sample["action"],
        "rewards": sample["next", "reward"][:, 0],
        "terminals": sample["next", "terminated"][:, 0],
        "timeouts": sample["next", "truncated"][:, 0],
        "next_observations": sample["next", "observation"],
    }
    for name, values in pairs.items():
        np.testing.assert_array_equal(values.numpy(), rolled[name], err_msg=name)
    done = rolled["terminals"] | rolled["timeouts"]
    np.testing.assert_array_equal(sample["next", "done"][:, 0].numpy(), done)


def test_floats_become_float32_and_integers_stay(tmp_path: Path, arrays: Transitions) -> None:
    arrays = {n: a.astype(np.float64) if a.dtype != bool else a for n, a in arrays.items()}
    arrays["terminals"] = arrays["terminals"].astype(np.uint8)
    arrays["rewards"] = arrays["rewards"][:, None]
    path = write(tmp_path / "a.hdf5", arrays)

    rows = read_hdf5(path).rows
    kept = read_hdf5(path, dtype=None).rows

    assert {rows[n].dtype for n in ("observation", "action", "reward")} == {torch.float32}
    assert {kept[n].dtype for n in ("observation", "action", "reward")} == {torch.float64}
    assert rows["terminated"].dtype == torch.bool


def test_a_trailing_unfinished_episode_is_separate(tmp_path: Path, arrays: Transitions) -> None:
    start, stop = spans(arrays)[-1]
    cut = {name: array[: stop - 1] for name, array in arrays.items()}
    assert stop - 1 > start

    episodes = read_hdf5(write(tmp_path / "a.hdf5", cut))

    assert_same_fields(episodes, cut)
    assert episodes.finished.tolist() == [True] * (len(spans(arrays)) - 1) + [False]
    assert len(HistoryStorage(episodes)) == start
    assert len(HistoryStorage(episodes, unfinished="keep")) == stop - 1


def test_other_fields_are_named_but_not_read(tmp_path: Path, rolled: Transitions) -> None:
    path = write(tmp_path / "a.hdf5", {**rolled, "infos/qpos": rolled["rewards"]})
    assert read_hdf5(path).left_out == ("infos/qpos",)


def test_hard_links_are_fields_of_each_name(tmp_path: Path) -> None:
    path = tmp_path / "a.hdf5"
    with h5py.File(path, "w") as file:
        file["data/states"] = np.arange(12.0)[:, None]
        file["observations"] = file["actions"] = file["data/states"]
        file["rewards"] = np.arange(12) % 4 == 3
        file["terminals"] = file["rewards"]
        file["elsewhere"] = h5py.SoftLink("data")

    episodes = read_hdf5(path)

    assert episodes.lengths.tolist() == [4, 4, 4]
    assert episodes.left_out == ("data/states", "elsewhere")


def test_what_is_large_and_not_needed_is_left_out(tmp_path: Path, rolled: Transitions) -> None:
    path = write(tmp_path / "a.hdf5", rolled, env_id="Hopper-v5")
    with h5py.File(path, "a") as file:
        file.attrs["authors"] = ["A", "B"]
        file.attrs["names"] = ["walk"] * 1000
        file.attrs["none"] = h5py.Empty("f")
        file.attrs["long"] = np.longdouble(0.5)
        nest(file.create_group("infos"))

    episodes = read_hdf5(path)

    assert episodes.attributes == {"env_id": "Hopper-v5", "authors": ["A", "B"], "long": 0.5}
    assert episodes.left_out == ("and others",)


def test_writing_is_lossless(tmp_path: Path, rolled: Transitions) -> None:
    unfinished = {name: array[:-1] for name, array in rolled.items()}
    path = write(tmp_path / "a.hdf5", unfinished, policy="random")

    write_hdf5(read_hdf5(path, dtype=None), tmp_path / "b.hdf5")

    with h5py.File(path) as before, h5py.File(tmp_path / "b.hdf5") as after:
        assert dict(before.attrs) == dict(after.attrs)
        assert set(before) == set(after)
        for name in before:
            assert before[name].dtype == after[name].dtype
            np.testing.assert_array_equal(before[name][:], after[name][:], err_msg=name)


def test_a_failed_write_leaves_nothing(
    tmp_path: Path, rolled: Transitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    episodes = read_hdf5(write(tmp_path / "a.hdf5", rolled))
    (tmp_path / "out").mkdir()

    def fail(*args: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(episodes_module, "rows_per_chunk", fail)
    monkeypatch.setattr("torchrl_tit.datasets.hdf5.rows_per_chunk", fail)
    with pytest.raises(OSError, match="no space left"):
        write_hdf5(episodes, tmp_path / "out" / "b.hdf5")
    assert list((tmp_path / "out").iterdir()) == []


def test_existing_file_is_not_overwritten(tmp_path: Path, rolled: Transitions) -> None:
    path = write(tmp_path / "a.hdf5", rolled)
    content = path.read_bytes()
    with pytest.raises(FileExistsError, match="exists already"):
        write_hdf5(read_hdf5(path), path)
    assert path.read_bytes() == content


def _break(arrays: Transitions, case: str) -> None:
    n = len(arrays["rewards"])
    zeros = np.zeros(n, dtype=bool)
    changes = {
        "missing": lambda: arrays.pop("actions"),
        "length": lambda: arrays.update(rewards=arrays["rewards"][:-1]),
        "nan": lambda: arrays["rewards"].__setitem__(7, np.nan),
        "infinity": lambda: arrays["observations"].__setitem__((8, 2), -np.inf),
        "too large": lambda: arrays.update(rewards=arrays["rewards"] + np.eye(1, n, 7)[0] * 1e300),
        "next nan": lambda: arrays["next_observations"].__setitem__((9, 0), np.nan),
        "bounds": lambda: arrays["actions"].__setitem__((10, 1), 1.01),
        "flag": lambda: arrays.update(terminals=arrays["rewards"] * 0 + 3),
        "no end": lambda: arrays.update(terminals=zeros, timeouts=zeros),
        "shape": lambda: arrays.update(rewards=arrays["actions"]),
        "scalars": lambda: arrays.update(observations=arrays["rewards"]),
        "dtype": lambda: arrays.update(actions=arrays["actions"].astype("S5")),
        "other task": lambda: arrays.update(actions=arrays["actions"][:, :2]),
        "next shape": lambda: arrays.update(next_observations=arrays["actions"]),
        "goes on": lambda: arrays["next_observations"].__setitem__((3, 0), 9),
        "empty": lambda: arrays.update({n: a[:0] for n, a in arrays.items()}),
    }
    changes[case]()


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("missing", "field 'actions': is missing; there is next_observations, observations"),
        ("length", r"field 'rewards': has \d+ rows, but 'observations' has \d+"),
        ("nan", "field 'rewards', row 7: is nan"),
        ("infinity", "field 'observations', row 8: is -inf"),
        (
            "too large",
            r"field 'rewards', row 7: is 1e\+300, but all values must be finite as fl",
        ),
        ("next nan", "field 'next_observations', row 9: is nan"),
        (
            "bounds",
            r"field 'actions', row 10: is 1.0\d*, but the task's actions range from -1.0",
        ),
        ("flag", "field 'terminals', row 0: is 3.0, but must be 0 or 1"),
        ("no end", "no episode ends in its"),
        ("shape", r"field 'rewards': one row has the shape \[3\]"),
        ("scalars", "field 'observations': one row is one number"),
        ("dtype", r"field 'actions': has the dtype \|S5, but must have a numeric one"),
        (
            "other task",
            r"field 'actions': one row has the shape \[2\], but in Hopper-v5",
        ),
        ("next shape", r"field 'next_observations': one row has the shape \[3\]"),
        ("goes on", "field 'next_observations', row 3: is not the observation of the next row"),
        ("empty", "field 'observations': has no rows"),
    ],
)
def test_errors_name_file_field_and_row(
    tmp_path: Path, arrays: Transitions, case: str, message: str
) -> None:
    _break(arrays, case)
    path = write(tmp_path / "bad.hdf5", arrays)
    with pytest.raises(DatasetError, match=f"^{re.escape(str(path))}: ?{message}"):
        read_hdf5(path, task=task_spaces("Hopper-v5"))


def test_a_task_of_the_same_sizes(tmp_path: Path) -> None:
    rolled = roll(task="Walker2d-v5", max_episode_steps=10)
    path = write(tmp_path / "a.hdf5", rolled, env_id="Walker2d-v5")
    assert read_hdf5(path, task=task_spaces("Walker2d-v4")).num_transitions == len(
        rolled["rewards"]
    )
    message = r"a.hdf5: field 'env_id': is Walker2d-v5, but the task is HalfCheetah-v5"
    with pytest.raises(DatasetError, match=message):
        load_episodes(path, task="HalfCheetah-v5")
    with pytest.raises(DatasetError, match="is walker2d, but the task is HalfCheetah-v5"):
        load_episodes("walker2d-medium-v0", task="HalfCheetah-v5", cache_dir=tmp_path / "none")
    assert not (tmp_path / "none").exists()  # nothing was downloaded


def test_row_is_right_beyond_the_first_chunk(
    tmp_path: Path, arrays: Transitions, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(episodes_module, "CHUNK_BYTES", 64)
    arrays["actions"][123, 2] = 5
    path = write(tmp_path / "bad.hdf5", arrays)
    with pytest.raises(DatasetError, match=r"field 'actions', row 123: is 5\.0"):
        read_hdf5(path, task=task_spaces("Hopper-v5"))


def test_truncated_file(tmp_path: Path, rolled: Transitions) -> None:
    path = write(tmp_path / "a.hdf5", rolled)
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(DatasetError, match=r"a\.hdf5: is not a whole HDF5 file .*truncated"):
        load_episodes(path)


def test_damaged_rows(tmp_path: Path, rolled: Transitions) -> None:
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


def test_other_files(tmp_path: Path) -> None:
    (tmp_path / "a.hdf5").write_text("observations")
    with pytest.raises(DatasetError, match="is not a whole HDF5 file"):
        load_episodes(tmp_path / "a.hdf5")
    with pytest.raises(FileNotFoundError, match=r"b\.hdf5"):
        load_episodes(tmp_path / "b.hdf5")
    with pytest.raises(ValueError, match="'hopper' is not a data set"):
        load_episodes("hopper")
    with pytest.raises(
        ValueError, match=r"not a data set: did you mean hopper-medium-v.*Minari has"
    ):
        load_episodes("hopper-medium-v9")
    with h5py.File(tmp_path / "c.hdf5", "w") as file:
        file["observations/state"] = [1.0]
    with pytest.raises(DatasetError, match="'observations': is missing; there is observations/st"):
        load_episodes(tmp_path / "c.hdf5")
