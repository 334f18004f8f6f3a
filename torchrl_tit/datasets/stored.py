"""Checks of untrusted HDF5 files: only data that a file itself holds are read."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

import h5py

from torchrl_tit.datasets.errors import DatasetError

# zlib's deflate, h5py's strongest built-in compression, expands one byte to at most 1032.
_MOST_BYTES_OF_ONE = 1100
_HARMLESS_BYTES = 64 * 2**20  # may be declared without being stored
_CHUNK_BYTES = 256 * 2**20  # a chunk is read as a whole, even for one of its rows
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


def check_group(source: str, group: h5py.Group) -> None:
    """Checks all fields of a group with :func:`check_stored`, before they are read.

    Args:
        source: The file, for error messages.
        group: The group.

    Raises:
        DatasetError: If the group links to another place, or a data set in it must not be read.

    Example:
        >>> with h5py.File.in_memory() as file:
        ...     file["episode_0/rewards"] = h5py.ExternalLink("/etc/hostname", "/")
        ...     check_group("a.hdf5", file["episode_0"])
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.errors.DatasetError: a.hdf5: field 'rewards': is a link to another...
    """
    links: list[tuple[str, object]] = []
    with damage_named(source, "cannot be read"):
        group.visititems_links(lambda name, link: links.append((name, link)))
        for name, link in links:
            check_link(source, name, link)
            item = group[name]
            if isinstance(item, h5py.Dataset):
                check_stored(source, name, item)


def check_link(source: str, name: str, link: object) -> None:
    """Checks that an entry of a group is stored there, not linked from elsewhere.

    Args:
        source: The file, for error messages.
        name: The entry's name.
        link: The result of ``group.get(name, getlink=True)``.

    Raises:
        DatasetError: If it is a link to another place.

    Example:
        >>> check_link("a.hdf5", "rewards", h5py.HardLink())
    """
    if not isinstance(link, h5py.HardLink):
        raise DatasetError(
            source, "is a link to another place, which is not read: copy the data here.", name
        )
