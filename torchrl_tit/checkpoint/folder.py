"""A folder of numbered checkpoints, written atomically.

folder/
000000018432/           one checkpoint, named after its step
tensors.safetensors
state.json            format, step, checksums, and the tree of codec.py
000000020480/
000000020480.new/       only for a moment, while a step is saved a second time
.tmp-.../               being written or being removed; left behind by a killed process
"""

from __future__ import annotations

import os
import re
import secrets
import shutil
from pathlib import Path
from typing import Any

from safetensors import SafetensorError

from torchrl_tit.checkpoint.codec import encode
from torchrl_tit.checkpoint.contents import read_contents, write_contents
from torchrl_tit.checkpoint.errors import CheckpointError, CheckpointNotFoundError
from torchrl_tit.files import fsync_directory

_NAME = re.compile(r"(\d{12,})(\.new)?")
_TEMPORARY = ".tmp-"


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
            f"there is no checkpoint in {folder}: the run was stopped before its first one, "
            "or this is not a run's checkpoint folder"
        )
    if step is None:
        step = max(paths)
    elif step not in paths:
        raise CheckpointNotFoundError(
            f"there is no checkpoint of step {step} in {folder}, only of "
            f"{', '.join(map(str, sorted(paths)))}"
        )
    return step, read_contents(paths[step], step)


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
    temporary = folder / f"{_TEMPORARY}{path.name}-{secrets.token_hex(4)}"
    temporary.mkdir()
    try:
        write_contents(temporary, step, tensors, tree)
        complete = path.with_name(f"{path.name}.new") if path.exists() else path
        os.rename(temporary, complete)
    except BaseException:  # Ctrl-C must leave nothing behind either
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    fsync_directory(folder)
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
    hidden = path.with_name(f"{_TEMPORARY}{path.name}-{secrets.token_hex(4)}")
    os.rename(path, hidden)
    shutil.rmtree(hidden)


def _tidy(folder: Path) -> None:
    """Completes or removes the leftovers of a killed process."""
    for path in list(folder.iterdir()):
        if path.name.startswith(_TEMPORARY):
            shutil.rmtree(path)
        elif (match := _NAME.fullmatch(path.name)) and match[2]:
            _promote(path)
