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

    If anything fails (a full disk, say), the old content stays at `path`.

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
    with whole_or_not_at_all(path, replace=True) as hidden, naming(path):
        hidden.write_bytes(data)


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
def whole_or_not_at_all(path: str | os.PathLike[str], *, replace: bool = False) -> Iterator[Path]:
    """Makes a file or folder under a hidden name, and renames it when it is complete.

    What was made is flushed to the disk first. If anything fails, it is removed.

    Args:
        path: the file or folder to make; its parent folder must exist.
        replace: whether it may be a file that exists already.

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
    # These errors name the file and its folder, not the hidden file.
    if not path.absolute().parent.is_dir():
        raise FileNotFoundError(f"{path} cannot be written: there is no folder {path.parent}")
    hidden = hidden_beside(path)
    try:
        _refuse_existing(path, replace)
        yield hidden
        with naming(path):
            for made in [hidden, *hidden.rglob("*")]:
                (fsync_directory if made.is_dir() else fsync_file)(made)
        _refuse_existing(path, replace)  # another process may have made it in the meantime
        with naming(path):
            os.replace(hidden, path)
    except BaseException:  # Ctrl-C must leave nothing behind either
        shutil.rmtree(hidden, ignore_errors=True)
        with contextlib.suppress(OSError):
            hidden.unlink(missing_ok=True)
        raise
    with naming(path):
        fsync_directory(path.parent)


def hidden_beside(path: Path) -> Path:
    """Returns a new hidden name, which :func:`remove_leftovers` finds if the process is killed."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")


def _refuse_existing(path: Path, replace: bool) -> None:
    if path.exists() and not replace:
        raise FileExistsError(f"{path} exists already; choose another name or delete it.")


@contextlib.contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Adds the name of the file being written to system errors, which a full disk's lack.

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
