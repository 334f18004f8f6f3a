"""HDF5 files that may be damaged or made to do harm, and disks that may be full.

Only values that a file itself holds are read, and no more than it can hold. HDF5 can take values
from any other file that a file names, and trusts any declared size: a file of a few kilobytes may
claim to hold terabytes. Every file of others is opened and every field found here.
"""

from __future__ import annotations

import contextlib
import io
import os
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from itertools import accumulate, islice
from math import prod
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from torchrl_tit.datasets.checks import DatasetError
from torchrl_tit.extras import Missing

try:
    import h5py
except ModuleNotFoundError:
    h5py = Missing("h5py")

# zlib's deflate, h5py's strongest built-in compression, expands one byte to at most 1032.
_MOST_BYTES_OF_ONE = 1100
_HARMLESS_BYTES = 64 * 2**20  # may be declared without being stored
_CHUNK_BYTES = 256 * 2**20  # a chunk is read as a whole, even for one of its rows
_ATTRIBUTE_BYTES = 2**20
_MOST_TEXTS = 16  # in an attribute, which can only be read as a whole
_MOST_ENTRIES = 1000  # arrays and groups that are listed
# Errors that h5py raises on damaged files.
_FAILURES = (KeyError, OSError, OverflowError, RuntimeError, TypeError, ValueError)


@contextlib.contextmanager
def damage_named(
    source: str, problem: str, field: str | None = None, row: int | None = None
) -> Iterator[None]:
    """Turns h5py's errors on damaged files into one error that names the place.

    Args:
        source: the file.
        problem: what is wrong, for the error message.
        field: name of the field, if the problem is in one.
        row: index of the row, if the problem is in one.

    Raises:
        DatasetError: if anything goes wrong inside.

    Example:
        >>> with damage_named("a.hdf5", "is not a whole HDF5 file", "rewards"):
        ...     raise OSError("truncated")
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.checks.DatasetError: a.hdf5: field 'rewards': is not a whole HDF5 f...
    """
    try:
        yield
    except DatasetError:
        raise
    except _FAILURES as error:
        raise DatasetError(source, f"{problem} ({error}).", field, row) from error


def open_hdf5(path: str | os.PathLike[str]) -> h5py.File:
    """Opens a file for reading.

    Raises:
        DatasetError: if it is not a complete HDF5 file.

    Example:
        >>> import tempfile
        >>> with tempfile.NamedTemporaryFile() as file:
        ...     open_hdf5(file.name)
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.checks.DatasetError: ...: is not a whole HDF5 file (Unable to synch...
    """
    with damage_named(str(path), "is not a whole HDF5 file"):
        return h5py.File(path, "r")


def find(source: str, group: h5py.Group, name: str) -> h5py.Dataset | h5py.Group | None:
    """Finds an entry of a file, and checks that the file itself holds its values.

    Args:
        source: the file, for error messages.
        group: the file, or a group in it.
        name: name of a field or a group in it.

    Returns:
        The field or group; None if there is none of that name.

    Raises:
        DatasetError: if it is a link to another place or a field with values in other files, if the
            file is too small for what the field declares, or if a chunk, which can only be read as
            a whole, is too large.

    Example:
        >>> with h5py.File.in_memory() as file:
        ...     file.create_dataset("rewards", (10**12,), "f4", chunks=(1024,))
        ...     find("a.hdf5", file, "rewards")
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.checks.DatasetError: a.hdf5: field 'rewards': declares 40000000000...
    """
    with damage_named(source, "cannot be read", name):
        if not group.id.links.exists(name.encode()):
            return None
        if group.id.links.get_info(name.encode()).type != h5py.h5l.TYPE_HARD:
            raise DatasetError(
                source, "is a link to another place, which is not read: copy the data here.", name
            )
        found = group[name]
        if not isinstance(found, h5py.Dataset):
            return found
        if found.is_virtual or found.external:
            raise DatasetError(
                source,
                "takes its values from other files, which are not read: copy them into this one.",
                name,
            )
        chunk = found.dtype.itemsize * prod(found.chunks or ())
        if chunk > _CHUNK_BYTES:
            raise DatasetError(
                source,
                f"has chunks of {chunk} bytes, but they are read as a whole and may have at most "
                f"{_CHUNK_BYTES}: write it with smaller chunks, such as h5py's chunks=True.",
                name,
            )
        held = min(found.id.get_storage_size(), found.file.id.get_filesize())
        check_size(source, found.dtype.itemsize * int(found.size or 0), held, name)
        return found


def check_size(source: str, declared: int, held: int, field: str | None = None) -> None:
    """Checks that values, possibly compressed, fit into the bytes that a file has for them.

    Args:
        source: the file, for error messages.
        declared: size of the values in bytes.
        held: bytes that the file has for them.
        field: name of the field, if they belong to one.

    Raises:
        DatasetError: if they do not fit.

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


def array_names(file: h5py.File) -> list[str]:
    """The full names of the arrays and links in a file, without reading them.

    Of a file with very many entries, some, and then "and others".

    Example:
        >>> with h5py.File.in_memory() as file:
        ...     file["infos/position"] = [1.0, 2.0]
        ...     array_names(file)
        ['infos/position']
    """
    entries = list(islice(_entries(file), _MOST_ENTRIES + 1))
    names = [name for name, is_group in entries[:_MOST_ENTRIES] if not is_group]
    return [*names, "and others"] if len(entries) > _MOST_ENTRIES else names


def _entries(group: h5py.Group) -> Iterator[tuple[str, bool]]:
    """Yields the full name of each entry below a group, and whether it is a group."""
    waiting = deque([("", group)])
    while waiting:
        prefix, place = waiting.popleft()
        for key in place.id:
            name = prefix + os.fsdecode(key)
            is_group = (
                place.id.links.get_info(key).type == h5py.h5l.TYPE_HARD
                and h5py.h5o.get_info(place.id, key).type == h5py.h5o.TYPE_GROUP
            )
            if is_group:
                waiting.append((f"{name}/", place[key]))
            yield name, is_group


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


class JoinedField:
    """A field that is stored in pieces, each of which is read when a slice needs it.

    HDF5's own virtual data sets would keep the files of all pieces open, but a process can only
    have about a thousand open files.

    Args:
        pieces: the number of rows of each piece, and a function that reads some of them, given the
            first and the one after the last.
        shape: shape of one row.
        dtype: dtype of all pieces.

    Example:
        >>> pieces = [(3, np.arange(3)), (2, np.array([10, 11]))]
        >>> field = JoinedField(
        ...     [(n, lambda a, b, x=x: x[a:b]) for n, x in pieces], (), np.dtype(int)
        ... )
        >>> field.shape, field[1:4].tolist()
        ((5,), [1, 2, 10])
    """

    def __init__(
        self,
        pieces: Sequence[tuple[int, Callable[[int, int], NDArray]]],
        shape: tuple[int, ...],
        dtype: np.dtype,
    ) -> None:
        self._readers = [read for _, read in pieces]
        self._bounds = [0, *accumulate(length for length, _ in pieces)]
        self.shape, self.dtype = (self._bounds[-1], *shape), dtype

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice) -> NDArray:
        start, stop, _ = rows.indices(len(self))
        values = np.empty((max(0, stop - start), *self.shape[1:]), self.dtype)
        number = bisect_right(self._bounds, start) - 1
        while start < stop:
            first, end = self._bounds[number], min(stop, self._bounds[number + 1])
            part = values[len(values) - (stop - start) :][: end - start]
            part[:] = self._readers[number](start - first, end - first).reshape(part.shape)
            start, number = end, number + 1
        return values


@contextlib.contextmanager
def new_hdf5(
    hidden: Path, path: str | os.PathLike[str]
) -> Iterator[tuple[h5py.File, Callable[[], None]]]:
    """Creates an HDF5 file; if it cannot be written, raises a single error with the reason.

    The HDF5 library does not survive a failed write: it tries again whenever one of its objects is
    freed, and finally crashes. So failures are hidden from it: every write appears to succeed, and
    the error is raised once the library has closed the file.

    Args:
        hidden: the file to create.
        path: the name that it will get, for error messages.

    Yields:
        The file, and a function that raises the error early, for long writes.

    Raises:
        OSError: if a write failed.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "a.hdf5"
        >>> with new_hdf5(path, path) as (file, check):
        ...     file["rewards"] = [1.0, 2.0]
        ...     check()
        >>> h5py.File(path)["rewards"][1]
        np.float64(2.0)
    """
    with _Disk(hidden, "w+") as disk:

        def check() -> None:
            if disk.error is not None:
                reason = disk.error.strerror or str(disk.error)
                raise OSError(f"{os.fspath(path)} cannot be written: {reason}") from disk.error

        with h5py.File(disk, "w") as file:
            yield file, check
        check()


class _Disk(io.FileIO):
    """A file that stores the first write error instead of raising it."""

    error: OSError | None = None

    def write(self, data: bytes | memoryview, /) -> int:  # type: ignore[override]
        """Writes all of the data, or nothing after an error."""
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while rest and self.error is None:
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.error = error
        return size

    def truncate(self, size: int | None = None, /) -> int:
        """Sets the file's size."""
        try:
            return super().truncate(size)
        except OSError as error:
            self.error = self.error or error
            return size or 0
