"""Reads Minari data sets."""

from __future__ import annotations

import os
from itertools import pairwise
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from torchrl_tit.datasets.checks import (
    FLAGS,
    check_actions,
    check_finite,
    kept_dtype,
    plain_tensor,
)
from torchrl_tit.datasets.episodes import Episodes
from torchrl_tit.datasets.errors import DatasetError
from torchrl_tit.datasets.memory_mapping import memory_mapped_rows
from torchrl_tit.datasets.minari_folder import check_folder, check_rows, episodes_checked
from torchrl_tit.datasets.optional import minari
from torchrl_tit.datasets.tasks import TaskSpaces, check_shape, check_task_name

# What Minari raises if a data set is damaged or cannot be downloaded.
_FAILURES = (
    AssertionError,
    AttributeError,
    ImportError,
    IndexError,
    KeyError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
)
ATTRIBUTES = "attributes"  # this library's entry in Minari's metadata
# Minari's own metadata fields, by the names of our attributes.
METADATA_FIELDS = {
    "algorithm": "algorithm_name",
    "description": "description",
    "author": "author",
    "author_email": "author_email",
    "code_permalink": "code_permalink",
}

# Minari's name of each field, and the number of rows of an episode beyond its steps.
FIELDS = {
    "observation": ("observations", 1),
    "action": ("actions", 0),
    "reward": ("rewards", 0),
    "terminated": ("terminations", 0),
    "truncated": ("truncations", 0),
}


def read_minari(
    name: str | os.PathLike[str],
    *,
    task: TaskSpaces | None = None,
    dtype: torch.dtype | None = torch.float32,
    directory: str | os.PathLike[str] | None = None,
) -> Episodes:
    """Reads a Minari data set, one episode at a time; it may be larger than memory.

    Args:
        name: A folder with a data set, or a data set's name such as "mujoco/hopper/medium-v0",
            which Minari downloads if it is not in Minari's own folder yet.
        task: The task whose shapes and action bounds the data must have; not checked if None.
        dtype: The dtype for floats; None keeps that of each field. Integers stay integers.
        directory: Folder for the memory-mapped rows; see
            :func:`~torchrl_tit.datasets.memory_mapping.memory_mapped_rows`.

    Returns:
        The episodes. An episode whose last step has no flag is unfinished. The attributes contain
        the metadata, and the name of the task as "env_id".

    Raises:
        FileNotFoundError: If Minari has no such data set, or cannot download it.
        DatasetError: If it is damaged, declares more than its files can hold, takes data from other
            files or is of another task; or if a field is missing, has the wrong length, shape or
            dtype, or contains NaN, infinity, or actions out of bounds.

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
    source = str(name)
    folder = _folder(name)
    dataset = _open(source, folder)
    attributes = _attributes(dataset)
    if task is not None:
        check_task_name(source, attributes.get("env_id"), task)
    lengths, left_out = _lengths(dataset, source)
    spec = dataset.env_spec
    if spec is not None and (spec.kwargs or spec.additional_wrappers):
        left_out.add("env_spec")  # except for the name
    bounds = [0, *(lengths + 1).cumsum(0).tolist()]
    rows = TensorDict({}, [0])
    places = episodes_checked(source, folder, len(lengths))
    for number, (place, (start, stop)) in enumerate(zip(places, pairwise(bounds), strict=True)):
        episode = _episode(dataset, number, place)
        left_out |= {"infos"} if episode.infos else set()
        fields = _checked(place, episode, stop - start - 1, task)
        kept = {
            field: (array.shape[1:], kept_dtype(place, FIELDS[field][0], array.dtype, dtype))
            for field, array in fields.items()
        }
        if number == 0:
            check_rows(source, folder, bounds[-1], _row_bytes(kept))
            rows = memory_mapped_rows(bounds[-1], kept, directory)
        for field, array in fields.items():
            target = rows[field][start : start + len(array)]
            _check_alike(place, FIELDS[field][0], array, target)
            target[:] = plain_tensor(array)
    return Episodes(
        rows=rows,
        lengths=lengths,
        final_known=torch.ones(len(lengths), dtype=torch.bool),
        source=source,
        attributes=attributes,
        left_out=tuple(sorted(left_out)),
    )


def is_minari_name(name: str) -> bool:
    """Returns whether a name has the form of Minari's, such as "mujoco/hopper/medium-v0".

    Args:
        name: The name.

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
    folder = Path(name).absolute()  # Minari cannot handle relative paths
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


def _open(source: str, folder: Path) -> minari.MinariDataset:
    check_folder(source, folder)
    try:
        return minari.MinariDataset(folder)
    except _FAILURES as error:
        raise DatasetError(
            source, f"is not a whole Minari data set ({error}): see {folder}."
        ) from error


def _attributes(dataset: minari.MinariDataset) -> dict[str, Any]:
    """The metadata of the data set, as strings, numbers and lists of them."""
    metadata = dataset.storage.metadata
    known = {name: metadata[place] for name, place in METADATA_FIELDS.items() if place in metadata}
    known = {name: sorted(v) if isinstance(v, set) else v for name, v in known.items()}
    if dataset.env_spec is not None:
        known["env_id"] = dataset.env_spec.id
    return {**known, **metadata.get(ATTRIBUTES, {})}


def _lengths(dataset: minari.MinariDataset, source: str) -> tuple[torch.Tensor, set[str]]:
    """The length of each episode, and the names of episode metadata that are not read."""
    noted: set[str] = set()
    steps = []
    try:
        for episode in dataset.storage.get_episode_metadata(dataset.episode_indices):
            steps.append(int(episode["total_steps"]))
            noted |= {name for name in ("seed", "options") if episode.get(name) is not None}
        lengths = torch.tensor(steps)  # raises if a number is too large
    except _FAILURES as error:
        raise DatasetError(source, f"its episodes cannot be listed ({error}).") from error
    if not len(lengths):
        raise DatasetError(source, "has no episodes.")
    if lengths.min() < 1:
        raise DatasetError(source, f"episode {int(lengths.argmin())} has no steps.")
    return lengths, noted


def _row_bytes(fields: dict[str, tuple[tuple[int, ...], torch.dtype]]) -> int:
    """Bytes of one row of all fields."""
    return sum(prod(shape) * dtype.itemsize for shape, dtype in fields.values())


def _episode(dataset: minari.MinariDataset, number: int, place: str) -> minari.EpisodeData:
    try:
        return dataset[number]
    except _FAILURES as error:
        raise DatasetError(place, f"cannot be read ({error}).") from error


def _checked(
    place: str, episode: minari.EpisodeData, length: int, task: TaskSpaces | None
) -> dict[str, NDArray]:
    """Checks the fields of an episode, and returns them under the names of our rows."""
    fields = {}
    for field, (name, more) in FIELDS.items():
        array = np.asarray(getattr(episode, name))
        if array.shape[:1] != (length + more,):
            raise DatasetError(
                place, f"has the shape {list(array.shape)}, but needs {length + more} rows.", name
            )
        # A field of scalars becomes a column, except for actions, which are then discrete.
        fields[field] = array[:, None] if array.ndim == 1 and field != "action" else array
    if task is not None:
        actions = fields["action"]
        if task.action.shape == () and actions.shape[1:] == (1,):
            fields["action"] = actions[:, 0]  # discrete, stored as a column
        check_shape(place, "observations", fields["observation"].shape[1:], task.observation, task)
        check_shape(place, "actions", fields["action"].shape[1:], task.action, task)
        check_actions(place, fields["action"], task.action)
    inside = ((fields["terminated"] != 0) | (fields["truncated"] != 0))[:-1].any(1)
    if inside.any():
        raise DatasetError(
            place,
            "ends the episode, but more steps follow.",
            "terminations",
            int(inside.argmax()),
        )
    return fields


def _check_alike(place: str, name: str, array: NDArray, target: torch.Tensor) -> None:
    """Checks that a field has the shape and dtype that it has in the first episode."""
    if array.shape != tuple(target.shape):
        problem = f"one row has the shape {list(array.shape[1:])}, not {list(target.shape[1:])}."
        raise DatasetError(place, problem, name)
    if array.dtype.kind == "f" and not target.is_floating_point() and name not in FLAGS:
        raise DatasetError(place, f"has the dtype {array.dtype}, but integers in episode 0.", name)
    check_finite(place, name, array, kept_as=target.dtype)
