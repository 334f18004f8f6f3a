"""Checks of untrusted HDF5 files: only data that a file itself holds are read."""

from __future__ import annotations

import contextlib
import os
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from math import prod

import numpy as np

from torchrl_tit.datasets.errors import DatasetError
from torchrl_tit.datasets.optional import h5py

# zlib's deflate, h5py's strongest built-in compression, expands one byte to at most 1032.
_MOST_BYTES_OF_ONE = 1100
_HARMLESS_BYTES = 64 * 2**20  # may be declared without being stored
_CHUNK_BYTES = 256 * 2**20  # a chunk is read as a whole, even for one of its rows
_ATTRIBUTE_BYTES = 2**20
_MOST_TEXTS = 16  # in an attribute, which can only be read as a whole
_MOST_ENTRIES = 1000  # fields and groups
_MOST_LINKS = 16  # from one to the next
_ROWS = 16  # of values of variable length that are read at a time
_ELSEWHERE = "is a link to another place, which is not read: copy the data here."
# Errors that h5py raises on damaged files.
_FAILURES = (KeyError, OSError, OverflowError, RuntimeError, TypeError, ValueError)


@contextlib.contextmanager
def damage_named(
    source: str, problem: str, field: str | None = None, row: int | None = None
) -> Iterator[None]:
    """Turns h5py's errors on damaged files into one error that names the place.

    Args:
        source: The file.
        problem: What is wrong, for the error message.
        field: Name of the field, if the problem is in one.
        row: Index of the row, if the problem is in one.

    Raises:
        DatasetError: If anything goes wrong inside.

    Example:
        >>> with damage_named("a.hdf5", "is not a whole HDF5 file", "rewards"):
        ...     raise OSError("truncated")
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.errors.DatasetError: a.hdf5: field 'rewards': is not a whole HDF5 f...
    """
    try:
        yield
    except DatasetError:
        raise
    except _FAILURES as error:
        raise DatasetError(source, f"{problem} ({error}).", field, row) from error


def open_hdf5(path: str | os.PathLike[str]) -> h5py.File:
    """Opens a file for reading.

    Args:
        path: The file.

    Raises:
        DatasetError: If it is not a complete HDF5 file.

    Example:
        >>> import tempfile
        >>> with tempfile.NamedTemporaryFile() as file:
        ...     open_hdf5(file.name)
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.errors.DatasetError: ...: is not a whole HDF5 file (Unable to synch...
    """
    with damage_named(str(path), "is not a whole HDF5 file"):
        return h5py.File(path, "r")


def check_stored(source: str, field: str, dataset: h5py.Dataset) -> None:
    """Checks that a field's values are in the file, before any are read.

    HDF5 can take values from any other file that the file names, and trusts any declared size: a
    file of a few kilobytes may claim to hold terabytes.

    Args:
        source: The file, for error messages.
        field: Name of the field.
        dataset: The field.

    Raises:
        DatasetError: If values are in other files, if the file is too small for what it declares,
            or if a chunk, which can only be read as a whole, is too large.

    Example:
        >>> with h5py.File.in_memory() as file:
        ...     endless = file.create_dataset("rewards", (10**12,), chunks=(1024,))
        ...     check_stored("a.hdf5", "rewards", endless)
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.errors.DatasetError: a.hdf5: field 'rewards': declares 40000000000...
    """
    with damage_named(source, "cannot be read", field):
        if dataset.is_virtual or dataset.external:
            raise DatasetError(
                source,
                "takes its values from other files, which are not read: copy them into this one.",
                field,
            )
        chunk = dataset.dtype.itemsize
        for length in dataset.chunks or ():
            chunk *= length
        if chunk > _CHUNK_BYTES:
            raise DatasetError(
                source,
                f"has chunks of {chunk} bytes, but they are read as a whole and may have at most "
                f"{_CHUNK_BYTES}: write it with smaller chunks, such as h5py's chunks=True.",
                field,
            )
        held = min(dataset.id.get_storage_size(), dataset.file.id.get_filesize())
        check_size(source, dataset.dtype.itemsize * int(dataset.size or 0), held, field)
        if dataset.dtype.kind == "O":
            _check_lengths(source, field, dataset)


def _check_lengths(source: str, field: str, dataset: h5py.Dataset) -> None:
    """Checks values of variable length, many of which can be the same one, stored once."""
    kind = h5py.check_vlen_dtype(dataset.dtype)
    if dataset.ndim != 1 or not (kind in (str, bytes) or np.dtype(kind).kind in "biuf"):
        raise DatasetError(source, f"has the dtype {dataset.dtype}, which is not read.", field)
    held = max(_HARMLESS_BYTES, dataset.file.id.get_filesize())
    total = 0
    for start in range(0, len(dataset), _ROWS):
        total += sum(map(len, dataset[start : start + _ROWS]))
        if total > held:
            raise DatasetError(
                source,
                f"has {total} bytes of data in its first rows, but the file holds {held}: it was "
                f"made to fill the memory.",
                field,
            )


def check_size(source: str, declared: int, held: int, field: str | None = None) -> None:
    """Checks that values, possibly compressed, fit into the bytes that a file has for them.

    Args:
        source: The file, for error messages.
        declared: Size of the values in bytes.
        held: Bytes that the file has for them.
        field: Name of the field, if they belong to one.

    Raises:
        DatasetError: If they do not fit.

    Example:
        >>> check_size("a.hdf5", declared=10**9, held=10**8)
    """
    if declared > max(_HARMLESS_BYTES, held * _MOST_BYTES_OF_ONE):
        raise DatasetError(
            source,
            f"declares {declared} bytes of data, but holds {held}: it is damaged or was made to "
            f"fill the memory.",
            field,
        )


def find(source: str, file: h5py.File, name: str) -> h5py.Dataset | None:
    """Finds an array by its name, also through hard and soft links within the file.

    Args:
        source: The file, for error messages.
        file: The file.
        name: The array's name.

    Returns:
        The array; None if there is no array of that name.

    Raises:
        DatasetError: If a link leads to another file, or nowhere.

    Example:
        >>> with h5py.File.in_memory() as file:
        ...     file["rewards"] = [1.0, 2.0]
        ...     file["terminals"] = h5py.SoftLink("/rewards")
        ...     find("a.hdf5", file, "terminals")[:], find("a.hdf5", file, "actions")
        (array([1., 2.]), None)
    """
    place, rest, links = file, [name], 0
    while rest:
        part, *rest = rest
        if not isinstance(place, h5py.Group) or not place.id.links.exists(part.encode()):
            if links:
                raise DatasetError(source, "is a link to something that is not there.", name)
            return None
        kind = place.id.links.get_info(part.encode()).type
        if kind == h5py.h5l.TYPE_HARD:
            place = place[part]
        elif kind == h5py.h5l.TYPE_SOFT and (links := links + 1) <= _MOST_LINKS:
            target = os.fsdecode(place.id.links.get_val(part.encode()))
            place = file if target.startswith("/") else place
            rest = [part for part in target.split("/") if part not in ("", ".")] + rest
        else:
            raise DatasetError(source, _ELSEWHERE, name)
    return place if isinstance(place, h5py.Dataset) else None


def array_names(file: h5py.File) -> list[str]:
    """The full names of the arrays and links in a file, without reading them.

    Of a file with very many entries, some, and then "and others".

    Example:
        >>> with h5py.File.in_memory() as file:
        ...     file["infos/position"] = [1.0, 2.0]
        ...     array_names(file)
        ['infos/position']
    """
    entries = list(islice(_walk(file), _MOST_ENTRIES + 1))
    names = [name for name, kind, _ in entries[:_MOST_ENTRIES] if kind in ("array", "link")]
    return [*names, "and others"] if len(entries) > _MOST_ENTRIES else names


def attribute_fits(place: h5py.File | h5py.Group, name: str) -> bool:
    """Returns whether an attribute is text or numbers that can be read in little memory.

    Values of variable length can all be the same long one, which is stored once.

    Example:
        >>> with h5py.File.in_memory() as file:
        ...     file.attrs["names"] = ["walk"] * 1000
        ...     attribute_fits(file, "names")
        False
    """
    attribute = place.attrs.get_id(name)
    kind, shape = attribute.dtype, attribute.shape
    if shape is None:  # it is empty
        return False
    text = h5py.check_string_dtype(kind)
    if text is not None and text.length is None:
        return prod(shape) <= _MOST_TEXTS
    return kind.kind in "biufS" and prod(shape) * kind.itemsize <= _ATTRIBUTE_BYTES


def check_group(source: str, group: h5py.Group) -> None:
    """Checks all fields of a group with :func:`check_stored`, before they are read.

    Args:
        source: The file, for error messages.
        group: The group.

    Raises:
        DatasetError: If the group links to another place, holds another group twice or very many
            fields, or a data set in it must not be read.

    Example:
        >>> with h5py.File.in_memory() as file:
        ...     file["episode_0/rewards"] = h5py.ExternalLink("/etc/hostname", "/")
        ...     check_group("a.hdf5", file["episode_0"])
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.errors.DatasetError: a.hdf5: field 'rewards': is a link to another...
    """
    with damage_named(source, "cannot be read"):
        for number, (name, kind, item) in enumerate(_walk(group)):
            if number == _MOST_ENTRIES:
                raise DatasetError(source, f"has more than {_MOST_ENTRIES} fields and groups.")
            if kind == "link":
                raise DatasetError(source, _ELSEWHERE, name)
            if kind == "group again":
                raise DatasetError(source, "is a group that is also in another place.", name)
            if item is not None:
                check_stored(source, name, item())


def check_link(source: str, file: h5py.File, name: str) -> None:
    """Checks that an entry of a file is stored there, not linked from elsewhere.

    Args:
        source: The file, for error messages.
        file: The file.
        name: The entry's name.

    Raises:
        DatasetError: If it is a link to another place.

    Example:
        >>> with h5py.File.in_memory() as file:
        ...     file["rewards"] = [1.0]
        ...     check_link("a.hdf5", file, "rewards")
    """
    if file.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
        raise DatasetError(source, _ELSEWHERE, name)


def _walk(
    group: h5py.Group,
) -> Iterator[tuple[str, str, Callable[[], h5py.Dataset] | None]]:
    """Yields what is below a group, each group's entries once, without following links.

    Yields:
        The full name; "array", "link", "group", or "group again"; and what opens an array.
    """
    waiting = deque([("", group)])
    seen = {h5py.h5o.get_info(group.id).addr}
    while waiting:
        prefix, place = waiting.popleft()
        for key in place.id:
            name = prefix + os.fsdecode(key)
            if place.id.links.get_info(key).type != h5py.h5l.TYPE_HARD:
                yield name, "link", None
                continue
            info = h5py.h5o.get_info(place.id, key)
            if info.type == h5py.h5o.TYPE_DATASET:
                yield name, "array", partial(place.__getitem__, key)
            elif info.type == h5py.h5o.TYPE_GROUP:
                again = info.addr in seen
                yield name, "group again" if again else "group", None
                if not again:
                    seen.add(info.addr)
                    waiting.append((f"{name}/", place[key]))
