"""A folder of numbered checkpoints, written atomically and checked when they are read.

A checkpoint is a folder of two files::

    folder/
        000000018432/           one checkpoint, named after its step
            tensors.safetensors
            state.json          format, step, checksums, and the tree of codec.py
        000000020480/
        000000020480.new/       only for a moment, while a step is saved a second time
        .000000020480.HEX.tmp/  being written or being removed; left behind by a killed process
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from torchrl_tit.checkpoint.codec import decode, encode
from torchrl_tit.files import fsync_directory, hidden_beside, remove_leftovers, whole_or_not_at_all

_NAME = re.compile(r"(\d{12,})(\.new)?")
_TENSORS = "tensors.safetensors"
_STATE = "state.json"
_FORMAT = "torchrl-tit checkpoint"
_VERSION = 1


class CheckpointError(OSError):
    """A checkpoint cannot be written or used; the message says why and what to do.

    Example:
        >>> issubclass(CheckpointError, OSError)
        True
    """


class CheckpointNotFoundError(CheckpointError, FileNotFoundError):
    """The requested checkpoint does not exist.

    Example:
        >>> issubclass(CheckpointNotFoundError, FileNotFoundError)
        True
    """


def save_checkpoint(folder: str | os.PathLike[str], step: int, state: Any, keep: int = 3) -> Path:
    """Saves a state as a new numbered checkpoint and removes the oldest ones.

    The checkpoint is written into a hidden folder, flushed to the disk and renamed, so a process
    that is killed at any moment leaves a complete checkpoint or none. Saving a step again replaces
    its checkpoint; a complete one exists at all times. Only one process at a time may save to a
    folder.

    Args:
        folder: folder of the run's checkpoints; created if missing.
        step: environment steps or updates done so far; the checkpoint's number.
        state: a nested state that :func:`~torchrl_tit.checkpoint.encode` accepts.
        keep: how many checkpoints to keep: this one and the ones before it. Checkpoints of later
            steps (of a run that was resumed from an earlier one) are also kept.

    Returns:
        The checkpoint's own folder.

    Raises:
        ValueError: `step` is negative or `keep` is not positive.
        TypeError: the state holds something that a checkpoint cannot hold.
        CheckpointError: it could not be written (for example, because the disk is full). Earlier
            checkpoints remain.

    Example:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> save_checkpoint(folder, 2048, {"frames": 2048}).name
        '000000002048'
        >>> load_checkpoint(folder)
        (2048, {'frames': 2048})
    """
    if step < 0:
        raise ValueError(f"step must not be negative, got {step}")
    if keep < 1:
        raise ValueError(f"keep must be at least 1, got {keep}")
    tensors, tree = encode(state)  # fails before anything is written
    folder = Path(folder)
    try:
        if not folder.is_dir():
            folder.mkdir(parents=True)
            fsync_directory(folder.parent)
        _tidy(folder)
        path = _add(folder, step, tensors, tree)
        for old in [other for other in checkpoint_steps(folder) if other <= step][:-keep]:
            _remove(folder / _name(old))
    except (OSError, SafetensorError) as error:
        raise CheckpointError(
            f"the checkpoint of step {step} could not be saved in {folder}: {error}. "
            "Checkpoints saved before are still there"
        ) from error
    return path


def load_checkpoint(folder: str | os.PathLike[str], step: int | None = None) -> tuple[int, Any]:
    """Loads the newest checkpoint, or the one of a step.

    Nothing in a checkpoint is ever executed, and both files are checked against their checksums.

    Args:
        folder: folder of the run's checkpoints.
        step: the checkpoint's number; the newest one by default.

    Returns:
        The step and the state, its tensors on the CPU.

    Raises:
        CheckpointNotFoundError: there is no checkpoint, or none of this step.
        CheckpointError: the checkpoint is damaged, from another program or version, or contains an
            unknown file. The message names its folder.

    Example:
        >>> import tempfile, torch
        >>> folder = tempfile.mkdtemp()
        >>> _ = save_checkpoint(folder, 10, {"weight": torch.zeros(2)})
        >>> _ = save_checkpoint(folder, 20, {"weight": torch.ones(2)})
        >>> load_checkpoint(folder)
        (20, {'weight': tensor([1., 1.])})
        >>> load_checkpoint(folder, step=10)
        (10, {'weight': tensor([0., 0.])})
    """
    folder = Path(folder)
    paths = _checkpoints(folder)
    if not paths:
        raise CheckpointNotFoundError(
            f"there is no checkpoint in {folder}: it was removed, the run was stopped before its "
            "first one, or this is not a run's checkpoint folder"
        )
    if step is None:
        step = max(paths)
    elif step not in paths:
        raise CheckpointNotFoundError(
            f"there is no checkpoint of step {step} in {folder}, only of "
            f"{', '.join(map(str, sorted(paths)))}"
        )
    return step, _read(paths[step], step)


def checkpoint_steps(folder: str | os.PathLike[str]) -> list[int]:
    """Lists the checkpoints in a folder.

    Args:
        folder: folder of the run's checkpoints; it need not exist.

    Returns:
        Their steps, the oldest first.

    Example:
        >>> checkpoint_steps("nowhere")
        []
    """
    return sorted(_checkpoints(Path(folder)))


def latest_step(folder: str | os.PathLike[str]) -> int | None:
    """Finds the newest checkpoint in a folder.

    Args:
        folder: folder of the run's checkpoints; it need not exist.

    Returns:
        Its step, or None if there is none.

    Example:
        >>> latest_step("nowhere") is None
        True
    """
    return max(_checkpoints(Path(folder)), default=None)


def remove_checkpoint(folder: str | os.PathLike[str], step: int) -> None:
    """Removes a checkpoint, if it is there.

    Args:
        folder: folder of the run's checkpoints.
        step: the checkpoint's number.

    Example:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> _ = save_checkpoint(folder, 10, {})
        >>> remove_checkpoint(folder, 10)
        >>> checkpoint_steps(folder)
        []
    """
    path = _checkpoints(Path(folder)).get(step)
    if path is not None:
        _remove(path)


def _name(step: int) -> str:
    return f"{step:012d}"


def _checkpoints(folder: Path) -> dict[int, Path]:
    """Returns the folder of each step's checkpoint; of two of the same step, the newer one."""
    found: dict[int, Path] = {}
    # In sorted order, "NAME.new" comes after "NAME" and replaces it.
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        if match := _NAME.fullmatch(path.name):
            found[int(match[1])] = path
    return found


def _add(folder: Path, step: int, tensors: dict[str, Any], tree: Any) -> Path:
    path = folder / _name(step)
    complete = path.with_name(f"{path.name}.new") if path.exists() else path
    with whole_or_not_at_all(complete) as hidden:
        hidden.mkdir()
        _write(hidden, step, tensors, tree)
    if complete != path:
        _promote(complete)
    return path


def _promote(new: Path) -> None:
    """Replaces a step's checkpoint with the one saved again."""
    path = new.with_suffix("")
    if path.exists():
        _remove(path)
    os.rename(new, path)
    fsync_directory(path.parent)


def _remove(path: Path) -> None:
    # Renamed first: a partly removed folder must not look like a checkpoint.
    hidden = hidden_beside(path)
    os.rename(path, hidden)
    shutil.rmtree(hidden)


def _tidy(folder: Path) -> None:
    """Completes or removes the leftovers of a killed process."""
    remove_leftovers(folder)
    for path in list(folder.iterdir()):
        if (match := _NAME.fullmatch(path.name)) and match[2]:
            _promote(path)


def _write(path: Path, step: int, tensors: dict[str, Tensor], tree: Any) -> None:
    """Writes a checkpoint's files into an empty folder."""
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


def _read(path: Path, step: int) -> Any:
    """Checks a checkpoint's files against their checksums and reads them."""
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
