"""HDF5 files on disks that may be full."""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from torchrl_tit.datasets.optional import h5py


@contextlib.contextmanager
def new_hdf5(
    hidden: Path, path: str | os.PathLike[str]
) -> Iterator[tuple[h5py.File, Callable[[], None]]]:
    """Creates an HDF5 file; if it cannot be written, raises a single error with the reason.

    The HDF5 library does not survive a failed write: it tries again whenever one of its objects is
    freed, and finally crashes. So failures are hidden from it: every write appears to succeed, and
    the error is raised once the library has closed the file.

    Args:
        hidden: The file to create.
        path: The name that it will get, for error messages.

    Yields:
        The file, and a function that raises the error early, for long writes.

    Raises:
        OSError: If a write failed.

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


@contextlib.contextmanager
def errors_named(path: str | os.PathLike[str]) -> Iterator[None]:
    """Adds the name of the file being written to errors that lack it.

    Args:
        path: The file or folder.

    Raises:
        OSError: If a write failed.

    Example:
        >>> with errors_named("a-v0"):
        ...     raise OSError(28, "No space left on device")
        Traceback (most recent call last):
        ...
        OSError: a-v0 cannot be written: No space left on device
    """
    try:
        yield
    except OSError as error:
        if os.fspath(path) in str(error):
            raise
        reason = error.strerror or str(error)
        raise OSError(f"{os.fspath(path)} cannot be written: {reason}") from error


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
