"""Minari data sets, read and written."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import minari
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete
from minari.data_collector import EpisodeBuffer

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

NAME = "walk/random-v0"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Minari's folder of the data set's files."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    return tmp_path / "minari" / NAME / "data"


def make(episode: Any, name: str = NAME, **settings: Any) -> Any:
    """A data set that Minari itself writes."""
    episodes = episode if isinstance(episode, list) else [episode]
    buffers = [EpisodeBuffer(**each) for each in episodes]
    settings = {"author": {"Ann"}, "author_email": {"a@b.c"}, "code_permalink": "x", **settings}
    settings = {"algorithm_name": "none", "description": "none", **settings}
    return minari.create_dataset_from_buffers(name, buffers, **settings)


def make_walk(arrays: Transitions, name: str = NAME) -> Any:
    episodes = []
    for start, stop in spans(arrays):
        names = {"actions": "actions", "rewards": "rewards"}
        names |= {"terminations": "terminals", "truncations": "timeouts"}
        steps = {theirs: list(arrays[ours][start:stop]) for theirs, ours in names.items()}
        last = arrays["next_observations"][stop - 1]
        episodes.append({"observations": [*arrays["observations"][start:stop], last], **steps})
    return make(
        episodes, name, env="Hopper-v5", observation_space=Box(-np.inf, np.inf, (11,), np.float32)
    )


def test_every_field_is_that_of_minari(rolled: Transitions, folder: Path) -> None:
    make_walk(rolled)
    expected = episodes_from_arrays(**rolled)
    for source in (NAME, folder, folder.parent):
        episodes = load_episodes(source, task="Hopper-v5")
        assert (episodes.rows == expected.rows).all()
        assert episodes.lengths.tolist() == [stop - start for start, stop in spans(rolled)]
        assert episodes.final_known.all()


def test_unknown_terminal_observations_are_copies_of_the_last(
    rolled: Transitions, tmp_path: Path
) -> None:
    """Zeros would be an observation that nobody has seen, in statistics, too."""
    whole = episodes_from_arrays(**rolled)
    number = int(whole.terminated.int().argmax())
    last = int(whole.last_rows[number])
    whole.rows["observation"][last + 1] = 0
    known = whole.final_known & (torch.arange(len(whole.lengths)) != number)
    part = replace(whole, final_known=known)
    write_minari(part, tmp_path / "walk-v0")
    write_hdf5(part, tmp_path / "walk.hdf5")
    for source in (tmp_path / "walk-v0", tmp_path / "walk.hdf5"):
        observations = load_episodes(source).rows["observation"]
        expected = whole.rows["observation"].clone()
        expected[last + 1] = expected[last]
        torch.testing.assert_close(observations, expected, rtol=0, atol=0)


def test_a_missing_set_is_downloaded(rolled: Transitions, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> None:
        raise RuntimeError(f"no network for {name}")

    monkeypatch.setattr(minari, "download_dataset", fail)
    message = f"There is no Minari data set '{NAME}' .* cannot be downloaded: no network for {NAME}"
    with pytest.raises(FileNotFoundError, match=message):
        load_episodes(NAME)
    monkeypatch.setattr(minari, "download_dataset", lambda name: make_walk(rolled, name))
    episodes = load_episodes(NAME)
    assert episodes.num_transitions == len(rolled["rewards"])
    assert episodes.source == NAME


def test_minari_reads_what_was_written(rolled: Transitions) -> None:
    write_minari(episodes_from_arrays(**rolled), NAME, "Hopper-v5")

    dataset = minari.load_dataset(NAME)

    assert dataset.total_episodes == len(spans(rolled))
    assert dataset.total_steps == len(rolled["rewards"])
    assert dataset.env_spec.id == "Hopper-v5"
    assert dataset.action_space == gymnasium.make("Hopper-v5").action_space
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

    with h5py.File(path, "a") as file:
        file["cuts"] = np.arange(9.0)  # an array of theirs with the name of an attribute of ours
    assert read_hdf5(path).left_out == ("array cuts",)
    told = replace(read_hdf5(path), attributes={"note": None})
    with pytest.raises(ValueError, match="HDF5 cannot store the attribute 'note', None"):
        write_hdf5(told, tmp_path / "c.hdf5")
    with h5py.File(path, "a") as file:
        del file["cuts"]
    with h5py.File(path) as before, h5py.File(tmp_path / "b.hdf5") as after:
        assert dict(before.attrs) == dict(after.attrs)
        for name in before:
            assert before[name].dtype == after[name].dtype
            np.testing.assert_array_equal(before[name][:], after[name][:], err_msg=name)


def test_metadata_survive(tmp_path: Path) -> None:
    episode = {
        "seed": 3,
        "options": {"low": 1},
        "observations": np.zeros((2, 11)),
        "actions": np.zeros((1, 3), np.float32),
        "rewards": [0.0],
        "terminations": [True],
        "truncations": [False],
        "infos": {"x": np.zeros(2)},
    }
    told = {
        "algorithm_name": "SAC",
        "author": {"Ann", "Bob"},
        "author_email": {"ann@example.org"},
        "code_permalink": "https://example.org/code",
        "description": "hops",
    }
    spec = gymnasium.make("Hopper-v5", terminate_when_unhealthy=False).spec
    make(episode, "hop/sac-v0", env=spec, **told)

    episodes = load_episodes("hop/sac-v0", dtype=None)
    write_hdf5(episodes, tmp_path / "a.hdf5")
    write_minari(load_episodes(tmp_path / "a.hdf5", dtype=None), "hop/sac-v1", "Hopper-v5")

    assert episodes.left_out == ("env_spec", "infos", "options", "seed")
    again = minari.load_dataset("hop/sac-v1")
    assert {name: again.storage.metadata[name] for name in told} == told
    assert again.env_spec.id == "Hopper-v5"
    assert again.action_space == Box(-1, 1, (3,), np.float32)
    attributes = load_episodes("hop/sac-v1").attributes
    assert attributes == load_episodes(tmp_path / "a.hdf5").attributes
    assert attributes == {
        "algorithm": "SAC",
        "author": ["Ann", "Bob"],
        "author_email": ["ann@example.org"],
        "code_permalink": "https://example.org/code",
        "description": "hops",
        "env_id": "Hopper-v5",
    }


@pytest.mark.parametrize(("shape", "jpeg"), [((40, 48, 3), True), ((40, 48), False)])
def test_images_and_discrete_actions(shape: tuple[int, ...], jpeg: bool, tmp_path: Path) -> None:
    """Images as Minari stores and decodes them; what we write is lossless."""
    frames = np.random.default_rng(0).integers(0, 256, (3, 4, *shape), dtype=np.uint8)
    steps = {"actions": [0, 2, 1], "rewards": [0.0, 0.0, 1.0]}
    steps |= {"terminations": [False, False, True], "truncations": [False] * 3}
    dataset = make(
        [{"observations": images, **steps} for images in frames],
        observation_space=Box(0, 255, shape, np.uint8),
        action_space=Discrete(3),
        jpeg_encoding=jpeg,
    )

    episodes = load_episodes(NAME)
    write_minari(episodes, tmp_path / "again-v0")

    expected = np.concatenate([episode.observations for episode in dataset])
    np.testing.assert_array_equal(episodes.rows["observation"].numpy(), expected)
    assert (expected == frames.reshape(12, *shape)).all() != jpeg
    assert episodes.rows["action"].tolist() == [0, 2, 1, 0] * 3
    assert (load_episodes(tmp_path / "again-v0").rows == episodes.rows).all()


@pytest.mark.parametrize("damage", [lambda x: x[:20], "size"])
def test_images_that_cannot_be_decoded(damage: Any, folder: Path) -> None:
    steps = {"actions": [0], "rewards": [0.0], "terminations": [True], "truncations": [False]}
    spaces: dict[str, Any] = {
        "observation_space": Box(0, 255, (40, 48), np.uint8),
        "action_space": Discrete(2),
    }
    make({"observations": np.zeros((2, 40, 48), np.uint8), **steps}, **spaces)
    path = folder / "metadata.json"
    if damage == "size":
        path.write_text(path.read_text().replace("[40, 48]", "[50, 48]"))
    else:
        with h5py.File(folder / "main_data.hdf5", "a") as file:
            images = file["episode_0/observations"][:]
            del file["episode_0/observations"]
            file["episode_0/observations"] = np.stack([damage(image) for image in images])
    with pytest.raises(DatasetError, match="'observations', row 0: rows from here on cannot be"):
        load_episodes(NAME)


def test_states_that_are_one_number_become_columns() -> None:
    steps = {"actions": [0, 1], "rewards": [0.0, 1.0]}
    steps |= {"terminations": [False, True], "truncations": [False, False]}
    spaces: dict[str, Any] = {"observation_space": Discrete(9), "action_space": Discrete(2)}
    make({"observations": np.array([5, 3, 8]), **steps}, **spaces)
    assert load_episodes(NAME).rows["observation"].tolist() == [[5], [3], [8]]


def test_an_episode_without_a_flag_is_unfinished(rolled: Transitions, folder: Path) -> None:
    start, stop = spans(rolled)[1]
    make_walk(rolled)
    with h5py.File(folder / "main_data.hdf5", "a") as file:
        for name in ("terminations", "truncations"):
            file["episode_1"][name][-1] = False

    episodes = load_episodes(NAME)

    assert episodes.finished.tolist() == [i != 1 for i in range(len(spans(rolled)))]
    everything = HistoryStorage(episodes_from_arrays(**rolled)).get(slice(None))
    drawn = torch.ones(len(everything), dtype=torch.bool)
    drawn[start:stop] = False
    found = HistoryStorage(episodes).get(slice(None)).exclude("episode")
    assert (found == everything[drawn].exclude("episode")).all()
    assert len(HistoryStorage(episodes, unfinished="keep")) == len(everything)
    with pytest.raises(ValueError, match="episode 1 is neither terminated nor truncated"):
        write_hdf5(episodes, "never-written.hdf5")


def _set(field: str, row: int, value: float) -> Callable[[h5py.Group], None]:
    return lambda episode: episode[field].__setitem__(row, value)


def _retype(field: str, add: float, dtype: type) -> Callable[[h5py.Group], None]:
    def change(episode: h5py.Group) -> None:
        values = (episode[field][:].astype(np.float64) + add).astype(dtype)
        del episode[field]
        episode[field] = values

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("rewards", 2, np.nan), "field 'rewards', row {2}: is nan"),
        (_set("observations", 3, np.inf), "field '(next_)?observations', row {[23]}: is inf"),
        (_set("actions", 1, -2.0), "field 'actions', row {1}: is -2.0, but the task's"),
        (_set("terminations", 0, True), "field 'terminals', row {0}: ends the episode, but"),
        (_set("truncations", 0, True), "field 'terminals', row {0}: ends the episode, but"),
        (
            _retype("rewards", 1e300, np.float64),
            "episode 1: field 'rewards': has the dtype float64",
        ),
        (_retype("actions", 0, int), "episode 1: field 'actions': has the dtype int64 and rows"),
        (lambda e: e["rewards"].resize(1, axis=0), "episode 1: field 'observations': has .* rows"),
        (lambda e: e.pop("actions"), "episode 1: field 'actions': is not an array"),
        (lambda e: e.file.pop(e.name), "field 'episode_1': is missing"),
    ],
)
def test_errors_name_the_place(
    rolled: Transitions, folder: Path, change: Callable[[h5py.Group], None], message: str
) -> None:
    """Rows are counted over all episodes."""
    make_walk(rolled)
    with h5py.File(folder / "main_data.hdf5", "a") as file:
        file["more"] = 0  # so that there are as many entries as episodes
        change(file["episode_1"])
    start = spans(rolled)[1][0]
    for step in range(4):
        message = message.replace(f"{{{step}}}", str(start + step))
    message = message.replace("{[23]}", f"({start + 2}|{start + 3})")
    with pytest.raises(DatasetError, match=f"^{NAME}: {message}"):
        load_episodes(NAME, task="Hopper-v5")


def test_damaged_sets(rolled: Transitions, folder: Path) -> None:
    make_walk(rolled)
    with pytest.raises(DatasetError, match="field 'env_id': is Hopper-v5, but the task is Walker2"):
        load_episodes(NAME, task="Walker2d-v5")
    walker = task_spaces("Walker2d-v5")._replace(name="a walker")
    with pytest.raises(DatasetError, match="field 'observations': one row has the shape"):
        load_episodes(NAME, task=walker)
    main, metadata = folder / "main_data.hdf5", folder / "metadata.json"
    text = metadata.read_text()
    metadata.write_text(text.replace('"data_format": "hdf5"', '"data_format": "arrow"'))
    with pytest.raises(DatasetError, match="is in the format 'arrow', but must be in HDF5"):
        load_episodes(NAME)
    metadata.write_text(text)
    main.write_bytes(main.read_bytes()[:-1000])
    with pytest.raises(DatasetError, match=r"main_data\.hdf5: is not a whole HDF5 file"):
        load_episodes(NAME)
    metadata.write_text("{")
    with pytest.raises(DatasetError, match="is not a whole Minari data set"):
        load_episodes(NAME)


@pytest.mark.parametrize("space", [MultiBinary(3), MultiDiscrete([2, 2, 2])])
def test_observations_of_several_categories(space: Any) -> None:
    seen = np.array([[0, 1, 1], [1, 0, 0], [1, 1, 0]], space.dtype)
    steps = {"actions": np.zeros((2, 1)), "rewards": [0.0, 1.0]}
    steps |= {"terminations": [False, True], "truncations": [False, False]}
    make({"observations": seen, **steps}, observation_space=space, action_space=Box(-1, 1, (1,)))
    episodes = load_episodes(NAME, max_episode_steps=2)
    assert episodes.rows["observation"].tolist() == seen.tolist()
    with pytest.raises(DatasetError, match="an episode of 2 steps, but max_episode_steps is 1"):
        load_episodes(NAME, max_episode_steps=1)


def test_observations_of_several_arrays_are_refused() -> None:
    steps = {"actions": np.zeros((1, 1)), "rewards": [0.0]}
    steps |= {"terminations": [True], "truncations": [False]}
    spaces: dict[str, Any] = {
        "observation_space": Dict(a=Box(-1, 1, (2,))),
        "action_space": Box(-1, 1, (1,)),
    }
    make({"observations": {"a": np.zeros((2, 2))}, **steps}, **spaces)
    with pytest.raises(DatasetError, match="its observations are a Dict space"):
        load_episodes(NAME)


def test_targets_that_cannot_be_written(
    rolled: Transitions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    episodes = episodes_from_arrays(**rolled)
    write_minari(episodes, tmp_path / "a-v0")
    with pytest.raises(FileExistsError, match="exists already"):
        write_minari(episodes, tmp_path / "a-v0")
    with pytest.raises(ValueError, match="'unnumbered' is not a valid name"):
        write_minari(episodes, tmp_path / "unnumbered")
    with pytest.raises(ValueError, match="'Hoper-v5' cannot be made"):
        write_minari(episodes, tmp_path / "b-v0", "Hoper-v5")
    assert [path.name for path in tmp_path.iterdir()] == ["a-v0"]
