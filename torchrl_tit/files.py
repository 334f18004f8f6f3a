"""Atomic writes: files that are complete or not there."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
from collections.abc import Collection, Iterator
from pathlib import Path

_HIDDEN = re.compile(r"\.(.+)\.[0-9a-f]{8}\.tmp")
"""Hidden names of files that are being written, or whose writer was killed."""


def write_bytes_atomic(path: str | os.PathLike[str], data: bytes) -> None:
    """Writes a file atomically: readers see the old content or the new, never a part of it.

    The bytes go to a hidden file next to the target, are flushed to the disk, and take the target's
    name in one rename. If anything fails (a full disk, say), the hidden file is removed and the old
    content stays at `path`.

    Args:
        path: the file to write; its folder must exist.
        data: all of its new content.

    Raises:
        FileNotFoundError: there is no such folder.
        OSError: the file could not be written.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> target = Path(tempfile.mkdtemp()) / "notes.bin"
        >>> write_bytes_atomic(target, b"all of it")
        >>> target.read_bytes()
        b'all of it'
    """
    path = Path(path)
    _check_folder(path)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    with naming(path):
        try:
            with temporary.open("xb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
        except BaseException:  # Ctrl-C must leave nothing behind either
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise
        fsync_directory(path.parent)


@contextlib.contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Adds the name of the file being written to system errors.

    If the disk is full, flushing an open file fails, and the error does not name the file.

    Args:
        path: the file.

    Raises:
        OSError: the original error, with the file's name.

    Example:
        >>> import errno
        >>> try:
        ...     with naming("notes.txt"):
        ...         raise OSError(errno.EIO, "Input/output error")
        ... except OSError as error:
        ...     print(error.filename)
        notes.txt
    """
    try:
        yield
    except OSError as error:
        error.filename, error.filename2 = str(path), None
        raise


def write_text_atomic(path: str | os.PathLike[str], text: str) -> None:
    """Writes a UTF-8 text file atomically, see :func:`write_bytes_atomic`.

    Args:
        path: the file to write; its folder must exist.
        text: all of its new content; line endings are kept.

    Raises:
        FileNotFoundError: there is no such folder.
        OSError: the file could not be written.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> target = Path(tempfile.mkdtemp()) / "notes.txt"
        >>> write_text_atomic(target, "all of it")
        >>> target.read_text(encoding="utf-8")
        'all of it'
    """
    write_bytes_atomic(path, text.encode("utf-8"))


def remove_leftovers(folder: str | os.PathLike[str], names: Collection[str] | None = None) -> None:
    """Removes the hidden files and folders that killed writes have left in a folder.

    Args:
        folder: a folder into which no other process writes.
        names: names of the files that were being written; any if None.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> folder = Path(tempfile.mkdtemp())
        >>> for name in ("a.json", ".a.json.0a1b2c3d.tmp", ".mine"):
        ...     folder.joinpath(name).touch()
        >>> remove_leftovers(folder)
        >>> sorted(path.name for path in folder.iterdir())
        ['.mine', 'a.json']
    """
    for path in list(Path(folder).iterdir()):
        match = _HIDDEN.fullmatch(path.name)
        if match is None or (names is not None and match[1] not in names):
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


@contextlib.contextmanager
def whole_or_not_at_all(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Makes a file or folder under a hidden name, and renames it when it is complete.

    Args:
        path: the file or folder to make, which must not exist yet; its parent folder must exist.

    Yields:
        The hidden name next to it, under which to make the file or folder.

    Raises:
        FileExistsError: it exists already; it is left unchanged.
        FileNotFoundError: there is no such parent folder.
        OSError: it could not be written.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> target = Path(tempfile.mkdtemp()) / "notes"
        >>> with whole_or_not_at_all(target) as hidden:
        ...     hidden.mkdir()
        ...     target.exists()
        False
        >>> target.exists()
        True
    """
    path = Path(path)
    _check_folder(path)
    hidden = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        if path.exists():
            raise FileExistsError(f"{path} exists already; choose another name or delete it.")
        yield hidden
        for made in [hidden, *hidden.rglob("*")]:
            (fsync_directory if made.is_dir() else fsync_file)(made)
        if path.exists():  # another process made it in the meantime
            raise FileExistsError(f"{path} exists already; choose another name or delete it.")
        os.replace(hidden, path)
    except BaseException:  # Ctrl-C must leave nothing behind either
        shutil.rmtree(hidden, ignore_errors=True)
        with contextlib.suppress(OSError):
            hidden.unlink(missing_ok=True)
        raise
    fsync_directory(path.parent)


def fsync_file(path: str | os.PathLike[str]) -> None:
    """Flushes a file's content to the disk.

    Args:
        path: an existing file.

    Raises:
        OSError: the flush failed.

    Example:
        >>> import tempfile
        >>> with tempfile.NamedTemporaryFile() as file:
        ...     fsync_file(file.name)
    """
    # Windows only flushes files that are open for writing.
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def fsync_directory(path: str | os.PathLike[str]) -> None:
    """Flushes a folder's list of names to the disk, so that a rename survives a power failure.

    Args:
        path: an existing folder.

    Raises:
        OSError: the flush failed.

    Example:
        >>> import tempfile
        >>> fsync_directory(tempfile.mkdtemp())
    """
    if os.name == "nt":  # Windows has no such call
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _check_folder(path: Path) -> None:
    """Raises an error that names the file and its folder, not the hidden file."""
    if not path.absolute().parent.is_dir():
        raise FileNotFoundError(f"{path} cannot be written: there is no folder {path.parent}")
