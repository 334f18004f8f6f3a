"""Loads a data set from any supported source."""

from __future__ import annotations

import difflib
import os
from pathlib import Path

import torch
from torchrl.data.datasets.d4rl_infos import D4RL_DATASETS

from torchrl_tit.datasets.d4rl import download_d4rl
from torchrl_tit.datasets.episodes import Episodes
from torchrl_tit.datasets.hdf5 import read_hdf5
from torchrl_tit.datasets.minari import is_minari_name, read_minari
from torchrl_tit.datasets.optional import minari
from torchrl_tit.datasets.scores import has_reference
from torchrl_tit.datasets.tasks import TaskSpaces, check_task_name, task_spaces
from torchrl_tit.datasets.transitions import Gaps

HDF5_SUFFIXES = (".hdf5", ".h5")


def load_episodes(
    source: str | os.PathLike[str],
    *,
    task: str | TaskSpaces | None = None,
    max_episode_steps: int | None = None,
    gaps: Gaps = "error",
    dtype: torch.dtype | None = torch.float32,
    directory: str | os.PathLike[str] | None = None,
    cache_dir: str | os.PathLike[str] | None = None,
) -> Episodes:
    """Reads a data set of any supported kind, in chunks, into memory-mapped rows.

    Args:
        source: An HDF5 file in D4RL's layout (".hdf5" or ".h5"); a folder with a Minari data set;
            D4RL's name of a data set, such as "hopper-medium-replay-v0"; or Minari's, such as
            "mujoco/hopper/medium-v0". Named data sets are downloaded once.
        task: The task that the data must match in shapes, action bounds and (if recorded) name: a
            name registered with Gymnasium, such as "Hopper-v5", or the spaces. Not checked if None.
        max_episode_steps: The time limit of an HDF5 file without "timeouts": see
            :func:`~torchrl_tit.datasets.transitions.episodes_from_transitions`.
        gaps: What to do where "next_observations" of an HDF5 file is not the observation of the
            next row: see the same function.
        dtype: The dtype for floats; None keeps that of each field. Integers stay integers.
        directory: A folder on a disk with room for the rows; no files remain there. By default the
            system's folder for temporary files.
        cache_dir: Folder of D4RL's files: see :func:`~torchrl_tit.datasets.download_d4rl`.

    Returns:
        The episodes.

    Raises:
        ValueError: If the source is none of these, or the task is unknown.
        FileNotFoundError: If there is no such file or data set.
        OSError: If the data set cannot be downloaded, or the disk is full.
        DatasetError: If the data cannot be used; the message names the file, field and row.

    Example:
        >>> load_episodes("hopper")
        Traceback (most recent call last):
        ...
        ValueError: 'hopper' is not a data set: give an HDF5 file, a Minari folder, D4RL's name ...
    """
    if not isinstance(source, str | os.PathLike) or not os.fspath(source):
        raise ValueError(f"source must name a file, a folder or a data set, not {source!r}")
    if not isinstance(task, str | TaskSpaces | None):
        raise ValueError(f"task must be a name, or what task_spaces returns, not {task!r}")
    spaces = task_spaces(task) if isinstance(task, str) else task
    name = os.fspath(source)
    path = Path(source)
    if name in D4RL_DATASETS and not path.exists():
        if spaces is not None and has_reference(name):  # such names begin with the task's name
            check_task_name(name, name.split("-")[0], spaces)
        path = download_d4rl(name, cache_dir)
    if path.is_file() or path.suffix in HDF5_SUFFIXES:
        return read_hdf5(
            path,
            task=spaces,
            max_episode_steps=max_episode_steps,
            gaps=gaps,
            dtype=dtype,
            directory=directory,
        )
    if path.is_dir() or is_minari_name(name):
        if not path.is_dir() and "/" not in name:
            _check_spelling(name)
        return read_minari(source, task=spaces, dtype=dtype, directory=directory)
    if path.is_absolute() or name.startswith("."):
        raise FileNotFoundError(f"There is no data set {name}.")
    raise ValueError(
        f"{name!r} is not a data set: give an HDF5 file, a Minari folder, D4RL's name (such as "
        f"'hopper-medium-replay-v0') or Minari's (such as 'mujoco/hopper/medium-v0')."
    )


def _check_spelling(name: str) -> None:
    """Raises ValueError if the name is a misspelling of one of D4RL's."""
    nearest = difflib.get_close_matches(name, D4RL_DATASETS, n=3, cutoff=0.8)
    if nearest and name not in minari.list_local_datasets():
        raise ValueError(
            f"{name!r} is not a data set: did you mean {' or '.join(nearest)}? Minari has no "
            "data set of that name on this machine."
        )
