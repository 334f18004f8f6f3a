"""HDF5 files in D4RL's layout."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_tit.datasets.checks import DatasetError
from torchrl_tit.datasets.episodes import Episodes, check_final_observations, rows_per_chunk
from torchrl_tit.datasets.hdf5_files import (
    array_names,
    attribute_fits,
    damage_named,
    find,
    h5py,
    new_hdf5,
    open_hdf5,
)
from torchrl_tit.datasets.transitions import CUTS, FIELDS, TIMESTAMPS, episodes_from_transitions
from torchrl_tit.files import whole_or_not_at_all

_MOST_CUTS = 16_000  # an attribute has room for 64 KB
_LIKE_TASK = ("observations", "actions", "next_observations")  # others are one number a row


def read_hdf5(path: str | os.PathLike[str], **settings: Any) -> Episodes:
    """Reads a file with one row per transition, in chunks; it may be larger than memory.

    Only values stored in the file itself are read, and no more than it can hold: see
    :func:`~torchrl_tit.datasets.hdf5_files.find`.

    Args:
        path: the file, with "observations" [N, *obs], "actions" [N, *action], "rewards" [N],
            "terminals" [N], and optionally "timeouts" [N], "next_observations" [N, *obs], and
            "timestamps" [N], whose order is checked. The attribute "cuts" of "timeouts" lists the
            rows at which an episode ends only because the data do, or have a gap.
            Other fields, attributes of fields, and attributes of the file that are neither text nor
            a few numbers, are not read.
        **settings: as for :func:`~torchrl_tit.datasets.transitions.episodes_from_transitions`,
            which describes how missing fields are replaced.

    Returns:
        The episodes.

    Raises:
        FileNotFoundError: if there is no such file.
        DatasetError: if it is not a complete HDF5 file, takes values from other files, declares
            more than it can hold, or its data cannot be used.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "a.hdf5"
        >>> with h5py.File(path, "w") as file:
        ...     for name, size in {"observations": 3, "actions": 1, "rewards": 1}.items():
        ...         file[name] = np.zeros((4, size), np.float32)
        ...     file["terminals"] = np.array([False, True, False, True])
        >>> read_hdf5(path).lengths
        tensor([2, 2])
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"There is no data file {path} in {Path.cwd()}: check the path, or create it first."
        )
    source = str(path)
    with open_hdf5(path) as file:
        with damage_named(source, "cannot be read"):
            # The arrays of the layout, and the names of others, which are not opened.
            others = set(array_names(file)) - set(FIELDS)
            fields: dict[str, Any] = dict.fromkeys(x if x != CUTS else f"array {x}" for x in others)
            attributes = _attributes(file)
            for name in set(file.attrs) - set(attributes):
                fields[f"attribute {name}"] = None
        for name in (*FIELDS, TIMESTAMPS):
            if isinstance(field := find(source, file, name), h5py.Dataset):
                fields[name] = field
                with damage_named(source, "its attributes cannot be read", name):
                    if set(field.attrs) - {CUTS}:
                        fields[f"attributes of {name}"] = None
                    if name == "timeouts" and CUTS in field.attrs:
                        fields[CUTS] = _cuts(source, field)
        return episodes_from_transitions(fields, source=source, attributes=attributes, **settings)


def write_hdf5(episodes: Episodes, path: str | os.PathLike[str]) -> None:
    """Writes episodes with one row per transition, in chunks.

    Fields keep their dtypes. Next observations are left out if none is known, because the data came
    without them; an unknown one after a terminal step is written as a copy of its observation.
    Which episodes are cut, D4RL's layout does not say: an attribute does.

    Args:
        episodes: the episodes. Only the last one may be unfinished.
        path: the file, which must not exist yet; it is written atomically.

    Raises:
        FileExistsError: if the file exists already.
        ValueError: if an episode before the last is unfinished, or the final observations of only
            some truncated ones are known; the layout cannot represent either. Or if HDF5 cannot
            store an attribute, such as None, or very many episodes are cut.
        OSError: if the file cannot be written.

    Example:
        >>> import tempfile
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> path = Path(tempfile.mkdtemp()) / "a.hdf5"
        >>> ends = np.array([False, True, False, True])
        >>> episodes = episodes_from_arrays(np.ones((4, 2)), np.ones((4, 1)), np.ones(4), ends)
        >>> write_hdf5(episodes, path)
        >>> read_hdf5(path).returns
        tensor([2., 2.], dtype=torch.float64)
    """
    if not episodes.finished[:-1].all():
        number = int((~episodes.finished).int().argmax())
        raise ValueError(
            f"{episodes.source}: episode {number} is neither terminated nor truncated, which the "
            f"layout of D4RL's files cannot represent for any episode but the last."
        )
    if episodes.final_known.any():
        check_final_observations(episodes)
    steps, ends = episodes.step_rows, episodes.lengths.cumsum(0) - 1
    kept = zip(FIELDS, ("observation", "action", "reward", "terminated", "truncated"), strict=False)
    fields = {name: (episodes.rows[field], steps) for name, field in kept}
    if episodes.final_known.any():
        following = steps + 1
        following[ends] = episodes.final_rows
        fields["next_observations"] = (episodes.rows["observation"], following)
    cuts = ends[episodes.cut].numpy().astype(np.uint32)
    if len(cuts) > _MOST_CUTS:
        raise ValueError(
            f"{episodes.source} has {len(cuts)} episodes that are cut at gaps, of which an HDF5 "
            f"file can note {_MOST_CUTS}: write it as a Minari data set"
        )
    with whole_or_not_at_all(path) as hidden, new_hdf5(hidden, path) as (file, check):
        for name, value in episodes.attributes.items():
            try:
                file.attrs[name] = value
            except (TypeError, ValueError) as error:
                raise ValueError(
                    f"{episodes.source}: HDF5 cannot store the attribute {name!r}, {value!r}: "
                    "remove it there, or write a Minari data set"
                ) from error
        for name, (values, rows) in fields.items():
            array = values.numpy()
            array = array if name in _LIKE_TASK else array.squeeze(-1)
            shape = (len(rows), *array.shape[1:])
            dataset = file.create_dataset(name, shape, array.dtype, chunks=True, compression="gzip")
            size = rows_per_chunk(array[0].nbytes)
            for start in range(0, len(rows), size):
                dataset[start : start + size] = array[rows[start : start + size].numpy()]
                check()
        if len(cuts):
            file["timeouts"].attrs[CUTS] = cuts


def _cuts(source: str, timeouts: h5py.Dataset) -> NDArray:
    """Whether an episode ends at a row only because the data do, or have a gap; bool [N]."""
    rows = np.asarray(timeouts.attrs[CUTS] if attribute_fits(timeouts, CUTS) else None)
    count = len(timeouts)
    if rows.dtype.kind not in "iu" or not ((rows >= 0) & (rows < count)).all():
        problem = f"its attribute {CUTS!r} must list some of its {count} rows."
        raise DatasetError(source, problem, "timeouts")
    cuts = np.zeros(count, bool)
    cuts[rows] = True
    return cuts


def _attributes(file: h5py.File) -> dict[str, Any]:
    """The attributes of the file, as strings, numbers and lists of them."""
    values = {
        name: np.asarray(file.attrs[name]) for name in file.attrs if attribute_fits(file, name)
    }
    return {
        name: (value.astype(float) if value.dtype == np.longdouble else value).tolist()
        for name, value in values.items()
    }
