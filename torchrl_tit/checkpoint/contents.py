"""The two files of one checkpoint, written and checked with checksums."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from torchrl_tit.checkpoint.codec import decode
from torchrl_tit.checkpoint.errors import CheckpointError
from torchrl_tit.files import fsync_directory, fsync_file

_TENSORS = "tensors.safetensors"
_STATE = "state.json"
_FORMAT = "torchrl-tit checkpoint"
_VERSION = 1


def write_contents(path: Path, step: int, tensors: dict[str, Tensor], tree: Any) -> None:
    """Writes a checkpoint's files into an empty folder and flushes them to the disk.

    Args:
        path: the folder.
        step: the checkpoint's number.
        tensors: tensors by name, see :func:`~torchrl_tit.checkpoint.codec.encode`.
        tree: the tree that belongs to the tensors.

    Raises:
        OSError: a file could not be written.
        SafetensorError: the tensors could not be written.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> folder = Path(tempfile.mkdtemp())
        >>> write_contents(folder, 7, {}, {"frames": 7})
        >>> sorted(file.name for file in folder.iterdir())
        ['state.json', 'tensors.safetensors']
        >>> read_contents(folder, 7)
        {'frames': 7}
    """
    save_file(tensors, path / _TENSORS)
    document = {
        "format": _FORMAT,
        "version": _VERSION,
        "step": step,
        "tensors": {
            "bytes": (path / _TENSORS).stat().st_size,
            "sha256": _sha256_of_file(path / _TENSORS),
        },
        "state": tree,
    }
    document["sha256"] = _sha256_of_document(document)
    (path / _STATE).write_text(json.dumps(document, allow_nan=False), encoding="utf-8")
    shutil.copymode(path / _STATE, path / _TENSORS)  # safetensors lets only the owner read
    for name in (_TENSORS, _STATE):
        fsync_file(path / name)
    fsync_directory(path)


def read_contents(path: Path, step: int) -> Any:
    """Checks a checkpoint's files against their checksums and reads them.

    Args:
        path: the checkpoint's folder.
        step: the step in its name.

    Returns:
        The state.

    Raises:
        CheckpointError: the checkpoint is damaged, from another program or version, or contains an
            unknown file.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> read_contents(Path(tempfile.mkdtemp()), 7)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        torchrl_tit.checkpoint.errors.CheckpointError: the checkpoint ... state.json is missing...
    """
    try:
        _check_names(path)
        document = _read_document(path / _STATE, step)
        _check_tensors(path / _TENSORS, document["tensors"])
        return decode(load_file(path / _TENSORS), document["state"])
    # A tree from elsewhere can be wrong in many ways (a wrong hex number, a wrong shape, a list
    # instead of an object), so any of these errors means that the checkpoint is unusable.
    except (
        *(ArithmeticError, AttributeError, LookupError, OSError, RuntimeError),
        *(SafetensorError, TypeError, ValueError),
    ) as error:
        raise CheckpointError(
            f"the checkpoint {path} cannot be used: {error}. "
            "Delete that folder to fall back to the checkpoint before it"
        ) from error


def _check_names(path: Path) -> None:
    names = {entry.name for entry in path.iterdir()}
    for name in (_STATE, _TENSORS):
        if name not in names:
            raise ValueError(f"{name} is missing")
        if (path / name).is_symlink() or not (path / name).is_file():
            raise ValueError(f"{name} is not a plain file")
    if foreign := sorted(names - {_STATE, _TENSORS}):
        raise ValueError(f"it contains unknown files: {', '.join(foreign)}")


def _read_document(file: Path, step: int) -> dict[str, Any]:
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{_STATE} is not valid JSON ({error})") from error
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        raise ValueError(f"{_STATE} does not say that it is a {_FORMAT}")
    if document.get("version") != _VERSION:
        raise ValueError(
            f"it has version {document.get('version')!r}, and this program reads {_VERSION}"
        )
    if document.pop("sha256", None) != _sha256_of_document(document):
        raise ValueError(f"{_STATE} was changed after it was written (wrong checksum)")
    if document["step"] != step:
        raise ValueError(f"it was saved at step {document['step']}, not at {step}")
    return document


def _check_tensors(file: Path, written: dict[str, Any]) -> None:
    size = file.stat().st_size
    if size != written["bytes"]:
        raise ValueError(f"{_TENSORS} has {size} bytes, but {written['bytes']} were written")
    if _sha256_of_file(file) != written["sha256"]:
        raise ValueError(f"{_TENSORS} was changed after it was written (wrong checksum)")


def _sha256_of_file(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _sha256_of_document(document: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(document).encode()).hexdigest()
