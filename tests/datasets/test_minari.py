"""Minari data sets, read and written."""

import re
from collections.abc import Callable
from pathlib import Path

import gymnasium
import h5py
import minari
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict
from minari.data_collector import EpisodeBuffer
from numpy.typing import NDArray

from tests.datasets.rollouts import Transitions, spans, write
from torchrl_tit.datasets import (
    DatasetError,
    HistoryStorage,
    episodes_from_arrays,
    load_episodes,
    read_hdf5,
    task_spaces,
    write_hdf5,
    write_minari,
)


@pytest.fixture(autouse=True)
def _minaris_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))


def make_with_minari(arrays: Transitions, name: str = "walk/random-v0") -> minari.MinariDataset:
    """A data set that Minari itself writes."""
    buffers = []
    for start, stop in spans(arrays):
        observations = [*arrays["observations"][start:stop], arrays["next_observations"][stop - 1]]
        buffers.append(
            EpisodeBuffer(
                observations=observations,
                actions=list(arrays["actions"][start:stop]),
                rewards=list(arrays["rewards"][start:stop]),
                terminations=list(arrays["terminals"][start:stop]),
                truncations=list(arrays["timeouts"][start:stop]),
            )
        )
    with pytest.warns(UserWarning, match="`author` is set to None"):
        return minari.create_dataset_from_buffers(
            name,
            buffers,
            env="Hopper-v5",
            observation_space=Box(-np.inf, np.inf, (11,), np.float32),
        )


def test_every_field_is_that_of_minari(rolled: Transitions) -> None:
    make_with_minari(rolled)

    episodes = load_episodes("walk/random-v0", task="Hopper-v5")

    sample = HistoryStorage(episodes).get(slice(None))
    expected = HistoryStorage(episodes_from_arrays(**rolled)).get(slice(None))
    assert (sample == expected).all()
    assert (episodes.rows == episodes_from_arrays(**rolled).rows).all()
    assert episodes.lengths.tolist() == [stop - start for start, stop in spans(rolled)]


def test_a_folder_is_read_too(rolled: Transitions, tmp_path: Path) -> None:
    make_with_minari(rolled)
    expected = load_episodes("walk/random-v0").rows
    folder = tmp_path / "minari" / "walk" / "random-v0"
    for path in (folder, folder / "data"):
        assert (load_episodes(path).rows == expected).all()


def test_minari_reads_what_was_written(rolled: Transitions) -> None:
    write_minari(episodes_from_arrays(**rolled), "walk/random-v1", "Hopper-v5")

    dataset = minari.load_dataset("walk/random-v1")

    assert dataset.total_episodes == len(spans(rolled))
    assert dataset.total_steps == len(rolled["rewards"])
    assert dataset.env_spec.id == "Hopper-v5"
    assert dataset.action_space == gymnasium.make("Hopper-v5").action_space
    assert list(minari.list_local_datasets()) == ["walk/random-v1"]
    for (start, stop), episode in zip(spans(rolled), dataset, strict=True):
        fields = {
            "actions": episode.actions,
            "rewards": episode.rewards,
            "terminals": episode.terminations,
            "timeouts": episode.truncations,
            "observations": episode.observations[:-1],
            "next_observations": episode.observations[1:],
        }
        for name, values in fields.items():
            assert values.dtype == rolled[name].dtype
            np.testing.assert_array_equal(values, rolled[name][start:stop], err_msg=name)


def test_hdf5_to_minari_and_back_is_lossless(rolled: Transitions, tmp_path: Path) -> None:
    unfinished = {name: array[:-1] for name, array in rolled.items()}
    path = write(tmp_path / "a.hdf5", unfinished, env_id="Hopper-v5", policy="random")

    write_minari(read_hdf5(path, dtype=None), tmp_path / "sets" / "a-v0")
    write_hdf5(load_episodes(tmp_path / "sets" / "a-v0", dtype=None), tmp_path / "b.hdf5")

    with h5py.File(path) as before, h5py.File(tmp_path / "b.hdf5") as after:
        assert dict(before.attrs) == dict(after.attrs)
        for name in before:
            assert before[name].dtype == after[name].dtype
            np.testing.assert_array_equal(before[name][:], after[name][:], err_msg=name)


def test_metadata_survive(tmp_path: Path) -> None:
    episode = EpisodeBuffer(
        seed=3,
        options={"low": 1},
        observations=np.zeros((2, 11)),
        actions=np.zeros((1, 3), np.float32),
        rewards=[0.0],
        terminations=[True],
        truncations=[False],
        infos={"x": np.zeros(2)},
    )
    told = {
        "algorithm_name": "SAC",
        "author": {"Ann", "Bob"},
        "author_email": {"ann@example.org"},
        "code_permalink": "https://example.org/code",
        "description": "hops",
    }
    env = gymnasium.make("Hopper-v5", terminate_when_unhealthy=False).spec
    minari.create_dataset_from_buffers("hop/sac-v0", [episode], env=env, **told)

    episodes = load_episodes("hop/sac-v0", dtype=None)
    write_hdf5(episodes, tmp_path / "a.hdf5")
    write_minari(load_episodes(tmp_path / "a.hdf5", dtype=None), "hop/sac-v1", "Hopper-v5")

    assert episodes.left_out == ("env_spec", "infos", "options", "seed")
    again = minari.load_dataset("hop/sac-v1")
    assert {name: again.storage.metadata[name] for name in told} == told
    assert again.env_spec.id == "Hopper-v5"
    assert again.action_space == Box(-1, 1, (3,), np.float32)
    attributes = load_episodes("hop/sac-v1").attributes
    assert attributes == episodes.attributes == load_episodes(tmp_path / "a.hdf5").attributes
    assert attributes["env_id"] == "Hopper-v5"


def test_images_and_discrete_actions_survive(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (6, 16, 16, 3), dtype=np.uint8)
    ends = np.array([False, False, True] * 2)
    episodes = episodes_from_arrays(frames, np.arange(6), np.ones(6), ends)

    write_minari(episodes, tmp_path / "images-v0")

    assert (load_episodes(tmp_path / "images-v0").rows == episodes.rows).all()


def test_an_episode_without_a_flag_is_unfinished(rolled: Transitions) -> None:
    arrays = {name: array.copy() for name, array in rolled.items()}
    start, stop = spans(rolled)[1]
    dataset = make_with_minari(arrays)
    with h5py.File(dataset.storage.data_path / "main_data.hdf5", "a") as file:
        for name in ("terminations", "truncations"):
            file["episode_1"][name][-1] = False

    episodes = load_episodes("walk/random-v0")

    assert episodes.finished.tolist() == [i != 1 for i in range(len(spans(rolled)))]
    everything = HistoryStorage(episodes_from_arrays(**rolled)).get(slice(None))
    drawn = torch.ones(len(everything), dtype=torch.bool)
    drawn[start:stop] = False
    assert (HistoryStorage(episodes).get(slice(None)) == everything[drawn]).all()
    assert len(HistoryStorage(episodes, unfinished="keep")) == len(everything)
    with pytest.raises(ValueError, match="episode 1 is neither terminated nor truncated"):
        write_hdf5(episodes, "never-written.hdf5")


@pytest.mark.parametrize(
    ("field", "row", "value", "message"),
    [
        ("rewards", 2, np.nan, "episode 1: field 'rewards', row 2: is nan"),
        ("observations", 3, np.inf, "episode 1: field 'observations', row 3: is inf"),
        ("actions", 1, -2.0, "episode 1: field 'actions', row 1: is -2.0, but the task's"),
        ("terminations", 0, True, "episode 1: field 'terminations', row 0: ends the episode, but"),
        ("rewards", slice(1), None, "episode 1: field 'rewards': has the shape"),
        ("actions", None, None, "episode 1: cannot be read"),
    ],
)
def test_errors_name_episode_field_and_row(
    rolled: Transitions, field: str, row: int | slice | None, value: float | None, message: str
) -> None:
    dataset = make_with_minari(rolled)
    with h5py.File(dataset.storage.data_path / "main_data.hdf5", "a") as file:
        if row is None:
            del file["episode_1"][field]
        elif isinstance(row, slice):
            file["episode_1"][field].resize(1, axis=0)
        else:
            file["episode_1"][field][row] = value
    with pytest.raises(DatasetError, match=f"^walk/random-v0: {message}"):
        load_episodes("walk/random-v0", task="Hopper-v5")


def test_damaged_sets(rolled: Transitions, tmp_path: Path) -> None:
    data = Path(make_with_minari(rolled).storage.data_path)
    with pytest.raises(DatasetError, match="field 'env_id': is Hopper-v5, but the task is Walker2"):
        load_episodes("walk/random-v0", task="Walker2d-v5")
    walker = task_spaces("Walker2d-v5")._replace(name="a walker")
    with pytest.raises(DatasetError, match="episode 0: field 'observations': one row has the sh"):
        load_episodes("walk/random-v0", task=walker)
    main = (data / "main_data.hdf5").read_bytes()
    (data / "main_data.hdf5").write_bytes(main[:-1000])
    with pytest.raises(DatasetError, match=r"main_data\.hdf5: is not a whole HDF5 file"):
        load_episodes("walk/random-v0")
    (data / "metadata.json").write_text("{")
    with pytest.raises(DatasetError, match="is not a whole Minari data set"):
        load_episodes("walk/random-v0")


@pytest.mark.parametrize(
    ("field", "values", "message"),
    [
        (
            "actions",
            lambda x: x.astype(int),
            "episode 1: field 'actions': has the dtype float32",
        ),
        ("rewards", lambda x: x + 1e300, "episode 0: field 'rewards', row 0: is 1e.300, but all"),
    ],
)
def test_numbers_that_would_be_changed(
    rolled: Transitions, field: str, values: Callable[[NDArray], NDArray], message: str
) -> None:
    dataset = make_with_minari(rolled)
    with h5py.File(dataset.storage.data_path / "main_data.hdf5", "a") as file:
        array = file["episode_0"][field][:].astype(np.float64)
        del file["episode_0"][field]
        file["episode_0"][field] = values(array)
    with pytest.raises(DatasetError, match=message):
        load_episodes("walk/random-v0")


def test_observations_of_several_arrays_are_refused() -> None:
    space = Dict(a=Box(-1, 1, (2,)))
    episode = EpisodeBuffer(
        observations={"a": np.zeros((2, 2))},
        actions=np.zeros((1, 1)),
        rewards=[0.0],
        terminations=[True],
        truncations=[False],
    )
    with pytest.warns(UserWarning, match="`author` is set to None"):
        minari.create_dataset_from_buffers(
            "many-v0",
            [episode],
            observation_space=space,
            action_space=Box(-1, 1, (1,)),
        )
    with pytest.raises(DatasetError, match="its observations are a Dict space"):
        load_episodes("many-v0")


def test_targets_that_cannot_be_written(rolled: Transitions, tmp_path: Path) -> None:
    episodes = episodes_from_arrays(**rolled)
    write_minari(episodes, tmp_path / "a-v0")
    with pytest.raises(FileExistsError, match="exists already"):
        write_minari(episodes, tmp_path / "a-v0")
    with pytest.raises(ValueError, match="'unnumbered' is not a valid name"):
        write_minari(episodes, tmp_path / "unnumbered")
    with pytest.raises(ValueError, match="'Hoper-v5' cannot be made"):
        write_minari(episodes, tmp_path / "b-v0", "Hoper-v5")
    assert [path.name for path in tmp_path.iterdir() if path.name != "minari"] == ["a-v0"]


def test_a_failed_write_leaves_nothing(
    rolled: Transitions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr("h5py.Group.create_dataset", fail)
    with pytest.raises(OSError, match="no space left"):
        write_minari(episodes_from_arrays(**rolled), tmp_path / "sets" / "a-v0")
    assert list((tmp_path / "sets").iterdir()) == []


def test_a_set_that_cannot_be_downloaded(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> None:
        raise RuntimeError(f"no network for {name}")

    monkeypatch.setattr(minari, "download_dataset", fail)
    message = "'mujoco/hopper/medium-v0' .* cannot be downloaded: no network for mujoco/hopper"
    with pytest.raises(FileNotFoundError, match=message):
        load_episodes("mujoco/hopper/medium-v0")


def test_a_missing_set_is_downloaded(rolled: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    def download(name: str) -> None:
        make_with_minari(rolled, name)

    monkeypatch.setattr(minari, "download_dataset", download)
    episodes = load_episodes("mujoco/walk/random-v0")
    assert episodes.num_transitions == len(rolled["rewards"])
    assert re.fullmatch("mujoco/walk/random-v0", episodes.source)
