"""Minari data sets.

Files of others are not handed to Minari, which makes the environment that they name, running any
function, and reads whole episodes into memory. They are HDF5 files with a group for each episode,
and are read like those of D4RL.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Iterator
from functools import partial
from math import prod
from pathlib import Path
from typing import Annotated, Any

import gymnasium
import msgspec
import numpy as np
import torch
from gymnasium.spaces import Box, Discrete
from imageio.v3 import imread
from numpy.typing import NDArray

from torchrl_tit.datasets.checks import DatasetError, task_spaces
from torchrl_tit.datasets.episodes import Episodes, check_final_observations
from torchrl_tit.datasets.hdf5_files import JoinedField, check_size, find, h5py, new_hdf5, open_hdf5
from torchrl_tit.datasets.transitions import CUTS, episodes_from_transitions
from torchrl_tit.envs import is_atari
from torchrl_tit.extras import Missing
from torchrl_tit.files import whole_or_not_at_all

try:
    import minari
except ModuleNotFoundError:
    minari = Missing("minari")

# Minari's name of each of D4RL's fields, and of our rows.
_NAMES = {
    "observations": ("observations", "observation"),
    "actions": ("actions", "action"),
    "rewards": ("rewards", "reward"),
    "terminals": ("terminations", "terminated"),
    "timeouts": ("truncations", "truncated"),
}
# Minari's own metadata fields, by the names of our attributes.
_METADATA_FIELDS = {
    "algorithm": "algorithm_name",
    "description": "description",
    "author": "author",
    "author_email": "author_email",
    "code_permalink": "code_permalink",
}
_Count = Annotated[int, msgspec.Meta(ge=0)]


class _Metadata(msgspec.Struct):
    """The fields of metadata.json that are read; there may be others."""

    total_episodes: _Count
    observation_space: str
    data_format: str = "hdf5"
    env_spec: str | None = None
    jpeg_encoding: bool = True
    algorithm_name: str | None = None
    description: str | None = None
    code_permalink: str | None = None
    author: list[str] | str | None = None
    author_email: list[str] | str | None = None
    attributes: dict[str, str | int | float | bool | list[Any] | None] = {}


class _Space(msgspec.Struct):
    """A space as Minari writes it."""

    type: str
    shape: list[_Count] = []


class _EnvSpec(msgspec.Struct):
    """A task as Gymnasium writes it."""

    id: str
    kwargs: dict[str, Any] | None = None
    additional_wrappers: list[Any] | None = None


def read_minari(name: str | os.PathLike[str], **settings: Any) -> Episodes:
    """Reads a Minari data set in HDF5, in chunks; it may be larger than memory.

    Args:
        name: a folder with a data set, or a data set's name such as "mujoco/hopper/medium-v0",
            which Minari downloads if it is not in Minari's own folder yet.
        **settings: ``task``, ``dtype`` and ``directory`` as for
            :func:`~torchrl_tit.datasets.transitions.episodes_from_transitions`.

    Returns:
        The episodes. An episode whose last step has no flag is unfinished. The attributes contain
        the metadata, and the name of the task as "env_id".

    Raises:
        FileNotFoundError: if Minari has no such data set, or cannot download it.
        DatasetError: if it is damaged, declares more than its files can hold, takes data from other
            files or is of another task; or if a field is missing, has the wrong length, shape or
            dtype, or contains NaN, infinity, or actions out of bounds. Rows are counted over all
            episodes.

    Example:
        >>> import tempfile
        >>> from torchrl_tit.datasets import episodes_from_arrays, write_minari
        >>> folder = Path(tempfile.mkdtemp()) / "walk-v0"
        >>> ends = np.array([False, True, False, True])
        >>> episodes = episodes_from_arrays(np.ones((4, 2)), np.ones((4, 1)), np.ones(4), ends)
        >>> write_minari(episodes, folder)
        >>> read_minari(folder).lengths
        tensor([2, 2])
    """
    source, folder = str(name), _folder(name)
    path = folder / "metadata.json"
    try:
        metadata = msgspec.convert(json.loads(path.read_bytes()), _Metadata)
        space = msgspec.convert(json.loads(metadata.observation_space), _Space)
        task = metadata.env_spec and msgspec.convert(json.loads(metadata.env_spec), _EnvSpec)
    except (OSError, RecursionError, ValueError) as error:
        raise DatasetError(
            source, f"is not a whole Minari data set ({error}): see {path}."
        ) from error
    if space.type not in ("Box", "Discrete", "MultiDiscrete", "MultiBinary"):
        problem = (
            f"its observations are a {space.type} space, but must be one array: store the one to "
            "read."
        )
        raise DatasetError(source, problem)
    if metadata.data_format != "hdf5":
        raise DatasetError(
            source, f"is in the format {metadata.data_format!r}, but must be in HDF5."
        )
    known = {ours: getattr(metadata, theirs) for ours, theirs in _METADATA_FIELDS.items()}
    attributes: dict[str, Any] = {
        name: sorted(value) if isinstance(value, list) else value
        for name, value in known.items()
        if value is not None
    }
    left_out = set()
    if task:
        attributes["env_id"] = task.id
        if task.kwargs or task.additional_wrappers:
            left_out.add("env_spec")  # except for the name
    with open_hdf5(folder / "main_data.hdf5") as file:
        if metadata.total_episodes > len(file):
            raise DatasetError(
                source,
                f"its metadata claim {metadata.total_episodes} episodes, but there are "
                f"{len(file)}: see {path}.",
            )
        if metadata.total_episodes == 0:
            raise DatasetError(source, "has no episodes.")
        image = tuple(space.shape) if metadata.jpeg_encoding and len(space.shape) > 1 else None
        fields, lengths, noted = _joined(source, file, metadata.total_episodes, image)
        left_out |= noted
        declared = sum(field.dtype.itemsize * prod(field.shape) for field in fields.values())
        check_size(source, declared, file.id.get_filesize())
        return episodes_from_transitions(
            {**fields, **dict.fromkeys(left_out)},
            source=source,
            attributes={**attributes, **metadata.attributes},
            lengths=lengths,
            **settings,
        )


def is_minari_name(name: str) -> bool:
    """Returns whether a name has the form of Minari's, such as "mujoco/hopper/medium-v0".

    Args:
        name: the name.

    Example:
        >>> is_minari_name("mujoco/hopper/medium-v0"), is_minari_name("./data.hdf5")
        (True, False)
    """
    try:
        minari.dataset.minari_dataset.parse_dataset_id(name)
    except (TypeError, ValueError):  # no version, or another form
        return False
    return True


def _folder(name: str | os.PathLike[str]) -> Path:
    """The folder of a data set's files, which are downloaded if necessary."""
    folder = Path(name).absolute()
    if folder.is_dir():
        return folder / "data" if (folder / "data").is_dir() else folder
    data = minari.storage.datasets_root_dir.get_dataset_path(str(name)) / "data"
    if not data.is_dir():
        try:
            minari.download_dataset(str(name))
        except Exception as error:  # the network or its client can raise anything
            raise FileNotFoundError(
                f"There is no Minari data set {str(name)!r} in {data.parent}, and it cannot be "
                f"downloaded: {error}"
            ) from error
    return data


def _joined(
    source: str, file: h5py.File, num_episodes: int, image: tuple[int, ...] | None
) -> tuple[dict[str, Any], NDArray, set[str]]:
    """Joins the fields of all episodes in the layout of D4RL.

    Args:
        source: the data set, for error messages.
        file: the file with a group for each episode.
        num_episodes: number of episodes.
        image: shape of an observation that may be stored as a JPEG image; None otherwise.

    Returns:
        The fields, the length of each episode, and the names of what is not read.
    """
    pieces: dict[str, list] = {name: [] for name in (*_NAMES, "next_observations")}
    rows: dict[str, tuple[tuple[int, ...], np.dtype]] = {}
    noted: set[str] = set()
    cuts: list[bool] = []
    for number in range(num_episodes):
        place = f"{source}: episode {number}"
        group = find(source, file, f"episode_{number}")
        if not isinstance(group, h5py.Group):
            raise DatasetError(source, "is missing.", f"episode_{number}")
        noted |= {"infos"} & set(group)
        cuts.append(CUTS in group.attrs)
        noted |= {"seed", "options"} & {key.split("/")[0] for key in group.attrs}
        found: dict[str, Any] = {n: find(place, group, theirs) for n, (theirs, _) in _NAMES.items()}
        for name, field in found.items():
            if not isinstance(field, h5py.Dataset) or not field.shape:
                raise DatasetError(place, "is not an array with one row per step.", _NAMES[name][0])
        steps = found["rewards"].shape[0]
        for name, field in found.items():
            more = name == "observations"  # the final one
            # A state that is one number becomes a column.
            row, dtype, read = field.shape[1:] or ((1,) if more else ()), field.dtype, _rows
            if more and image is not None and field.ndim <= 2:
                row, dtype, read = image, np.dtype(np.uint8), _images
            expected = rows.setdefault(name, (row, dtype))
            problem = None
            if len(field) != steps + more or steps == 0:
                problem = f"has {len(field)} rows, but needs {steps + more}, and one step at least."
            elif (row, dtype) != expected:
                problem = (
                    f"has the dtype {dtype} and rows of the shape {list(row)}, but in "
                    f"episode 0 {expected[1]} and {list(expected[0])}."
                )
            if problem:
                raise DatasetError(place, problem, _NAMES[name][0])
            pieces[name].append((steps, partial(read, file, field.name, row)))
            if more:
                later = partial(_later, pieces[name][-1][1])
                pieces["next_observations"].append((steps, later))
    rows["next_observations"] = rows["observations"]
    fields = {name: JoinedField(parts, *rows[name]) for name, parts in pieces.items()}
    lengths = np.array([steps for steps, _ in pieces["rewards"]])
    return fields | {CUTS: np.repeat(cuts, lengths)}, lengths, noted


def _rows(file: h5py.File, name: str, shape: tuple[int, ...], start: int, stop: int) -> NDArray:
    """Reads rows of a field."""
    return file[name][start:stop]


def _later(read: Callable[[int, int], NDArray], start: int, stop: int) -> NDArray:
    """Reads the rows that each follow one of these."""
    return read(start + 1, stop + 1)


def _images(file: h5py.File, name: str, shape: tuple[int, ...], start: int, stop: int) -> NDArray:
    """Reads and decodes JPEG images, each of which is a row of bytes."""
    field, images = file[name], np.empty((stop - start, *shape), np.uint8)
    for row in range(start, stop):
        try:
            image = imread(bytes(field[row]), extension=".jpg")
        except Exception as error:  # whatever a damaged image raises, or one of too many pixels
            raise ValueError(str(error)) from error
        if image.shape != shape:
            raise ValueError(f"an image is of {image.shape}, but the space of {shape}")
        images[row - start] = image
    return images


def write_minari(
    episodes: Episodes, name: str | os.PathLike[str], env_name: str | None = None
) -> None:
    """Writes episodes as a Minari data set, one at a time.

    Fields keep their dtypes. An unknown observation after a terminal step is written as a copy of
    the one before it. Minari writes its metadata; this function writes the episodes, in Minari's
    layout, because it survives a full disk. The attributes "algorithm", "description", "author",
    "author_email" and "code_permalink" also go into Minari's own metadata.

    Args:
        episodes: the data.
        name: the folder to create, an absolute path or one that begins with a dot, whose last part
            ends in a version such as "-v0"; or the name of a data set in Minari's own folder.
        env_name: the Gymnasium task of the data, from which Minari can recreate the environment.
            For Atari games it only determines the action space, because the environment that Minari
            recreates has different images from :func:`~torchrl_tit.envs.make_env`.

    Raises:
        FileExistsError: if the data set exists already.
        ValueError: if Minari does not accept the name, or Gymnasium does not know the task.
        DatasetError: if the final observation of a truncated episode is unknown.
        OSError: if it cannot be written.

    Example:
        >>> import tempfile
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> folder = Path(tempfile.mkdtemp()) / "walk-v0"
        >>> episodes = episodes_from_arrays(np.ones((2, 2)), np.ones((2, 1)), np.ones(2), [0, 1])
        >>> write_minari(episodes, folder)
        >>> minari.MinariDataset(folder / "data")[0].observations.shape
        (3, 2)
    """
    check_final_observations(episodes)
    folder, dataset_id = _target(name)
    action = episodes.rows["action"]
    if env_name is not None:
        action_space = task_spaces(env_name).action
    else:
        action_space = Discrete(int(action.max()) + 1) if action.ndim == 1 else _box(action)
    remade = None if env_name is None or is_atari(env_name) else gymnasium.spec(env_name)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with whole_or_not_at_all(folder) as hidden, _errors_named(folder):
        hidden.mkdir()
        storage = minari.dataset.minari_storage.MinariStorage.new(
            hidden / "data",
            observation_space=_box(episodes.rows["observation"]),
            action_space=action_space,
            env_spec=remade,
            jpeg_encoding=False,  # images are stored losslessly
        )
        with new_hdf5(hidden / "data" / "main_data.hdf5", folder) as (file, check):
            for number, steps in enumerate(_steps(episodes)):
                group = file.create_group(f"episode_{number}")
                group.attrs.update({"id": number, "total_steps": len(steps["rewards"])})
                if episodes.cut[number]:
                    group.attrs[CUTS] = True
                for field, values in steps.items():
                    shape = (None, *values.shape[1:])  # resizable, like Minari's own
                    group.create_dataset(field, data=values, chunks=True, maxshape=shape)
                check()
        storage.update_metadata(
            {
                "dataset_id": dataset_id,
                "minari_version": minari.__version__,
                "total_episodes": len(episodes.lengths),
                "total_steps": episodes.num_transitions,
                "dataset_size": storage.get_size(),
                "attributes": dict(episodes.attributes),
                **_listed(episodes),
            }
        )


def _target(name: str | os.PathLike[str]) -> tuple[Path, str]:
    """Returns the folder to write to, and the data set's name."""
    path = Path(name)
    if path.is_absolute() or str(name).startswith("."):
        folder, dataset_id = path.absolute(), path.name  # Minari cannot handle relative paths
    else:
        folder = minari.storage.datasets_root_dir.get_dataset_path(str(name))
        dataset_id = str(name)
    if not is_minari_name(dataset_id):
        raise ValueError(
            f"{dataset_id!r} is not a valid name of a Minari data set: it must end in a version, "
            f"as 'medium-v0' does."
        )
    return folder, dataset_id


@contextlib.contextmanager
def _errors_named(path: Path) -> Iterator[None]:
    """Adds the name of the folder being written to errors that lack it."""
    try:
        yield
    except OSError as error:
        if str(path) in str(error):
            raise
        raise OSError(f"{path} cannot be written: {error.strerror or error}") from error


def _listed(episodes: Episodes) -> dict[str, Any]:
    """The attributes that have a field in Minari's metadata: texts, and sets of people."""
    listed: dict[str, Any] = {}
    for ours, theirs in _METADATA_FIELDS.items():
        value = episodes.attributes.get(ours)
        people = ours.startswith("author")
        if isinstance(value, str):
            listed[theirs] = {value} if people else value
        elif isinstance(value, list) and people:
            listed[theirs] = set(value)
    return listed


def _box(values: torch.Tensor) -> Box:
    """A space of arrays whose bounds are unknown."""
    array = values[:1].numpy()
    floating = np.issubdtype(array.dtype, np.floating)
    low = -np.inf if floating else np.iinfo(array.dtype).min
    high = np.inf if floating else np.iinfo(array.dtype).max
    return Box(low, high, array.shape[1:], array.dtype.type)


def _steps(episodes: Episodes) -> Iterator[dict[str, NDArray]]:
    """The fields of each episode by Minari's names."""
    rows = (episodes.first_rows, episodes.last_rows, episodes.final_rows)
    for first, last, final in zip(*(row.tolist() for row in rows), strict=True):
        steps, taken = {}, [*range(first, last + 1)]
        for name, (theirs, ours) in _NAMES.items():
            wanted = [*taken, final] if name == "observations" else taken
            values = episodes.rows[ours][wanted].numpy()
            steps[theirs] = values if name in ("observations", "actions") else values.squeeze(-1)
        yield steps
