"""Loads a data set from any supported source; downloads those of D4RL."""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import os
import urllib.request
from pathlib import Path
from urllib.error import URLError
from urllib.parse import urlsplit

import msgspec
import torch
from torchrl.data.datasets.d4rl_infos import D4RL_DATASETS

from torchrl_tit.datasets.checks import (
    DatasetError,
    TaskSpaces,
    check_limit,
    check_task_name,
    task_spaces,
)
from torchrl_tit.datasets.episodes import Episodes
from torchrl_tit.datasets.hdf5 import read_hdf5
from torchrl_tit.datasets.hdf5_files import damage_named, h5py
from torchrl_tit.datasets.minari import is_minari_name, minari, read_minari
from torchrl_tit.datasets.transitions import Gaps
from torchrl_tit.files import whole_or_not_at_all, write_text_atomic
from torchrl_tit.scores import has_reference

HDF5_SUFFIXES = (".hdf5", ".h5")
_HOST = "rail.eecs.berkeley.edu"  # hosts all of D4RL's files
_BLOCK = 2**20
_TIMEOUT = 60  # seconds without an answer


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
        source: an HDF5 file in D4RL's layout (".hdf5" or ".h5"); a folder with a Minari data set;
            D4RL's name of a data set, such as "hopper-medium-replay-v0"; or Minari's, such as
            "mujoco/hopper/medium-v0". Named data sets are downloaded once.
        task: the task that the data must match in shapes, action bounds and (if recorded) name: a
            name registered with Gymnasium, such as "Hopper-v5", or the spaces. Not checked if None.
        max_episode_steps: the time limit of an HDF5 file without "timeouts", see
            :func:`~torchrl_tit.datasets.transitions.episodes_from_transitions`. No episode of
            other data may be longer.
        gaps: what to do at gaps in an HDF5 file's "next_observations" or "timestamps": see the same
            function.
        dtype: the dtype for floats; None keeps that of each field. Integers stay integers.
        directory: a folder on a disk with room for the rows; no files remain there. By default the
            system's folder for temporary files.
        cache_dir: folder of D4RL's files: see :func:`~torchrl_tit.datasets.download_d4rl`.

    Returns:
        The episodes.

    Raises:
        ValueError: if the source is none of these, or the task is unknown.
        FileNotFoundError: if there is no such file or data set.
        OSError: if the data set cannot be downloaded, or the disk is full.
        DatasetError: if the data cannot be used; the message names the file, field and row.

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
    reading = {"task": spaces, "dtype": dtype, "directory": directory}
    if path.is_file() or path.suffix in HDF5_SUFFIXES:
        return read_hdf5(path, max_episode_steps=max_episode_steps, gaps=gaps, **reading)
    if path.is_dir() or is_minari_name(name):
        if not path.is_dir() and "/" not in name:
            _check_spelling(name)
        episodes = read_minari(source, **reading)
        check_limit(name, episodes.lengths.numpy(), max_episode_steps)
        return episodes
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


def download_d4rl(name: str, cache_dir: str | os.PathLike[str] | None = None) -> Path:
    """Downloads one of D4RL's data sets, unless it has been downloaded before.

    Files are downloaded over https and written atomically. D4RL publishes no checksums, so the
    first download is trusted: it must have the length that the server states and be a complete HDF5
    file. Its size and SHA-256 are stored next to it. They are verified whenever the file is used
    again, and remain if it is deleted: a second download must be the same file.

    Args:
        name: D4RL's name, such as "hopper-medium-replay-v0" or "hopper-medium-v2".
        cache_dir: folder for the files; by default "torchrl-tit/d4rl" in the user's cache folder
            (``$XDG_CACHE_HOME``, or ``~/.cache``).

    Returns:
        The file.

    Raises:
        ValueError: if D4RL has no data set of that name.
        OSError: if the file cannot be downloaded or written, or the server redirects away from
            https.
        DatasetError: if the file is damaged, or not the one that was downloaded first.

    Source: D4RL (arXiv 2004.07219); the URLs are those of TorchRL, which begin with http.

    Example:
        >>> download_d4rl("hopper-medium")
        Traceback (most recent call last):
        ...
        ValueError: D4RL has no data set 'hopper-medium'; names consist of task, kind and ve...
    """
    if name not in D4RL_DATASETS:
        raise ValueError(
            f"D4RL has no data set {name!r}; names consist of task, kind and version, as in "
            f"'hopper-medium-replay-v0'."
        )
    folder = _cache_folder() if cache_dir is None else Path(cache_dir)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.hdf5"
    record = folder / f"{name}.json"
    if not path.exists():
        # If another process was faster, its download is used.
        with contextlib.suppress(FileExistsError), whole_or_not_at_all(path) as hidden:
            _download(address(name), hidden)
            other = f"sends another file than before; delete {record} to accept it"
            _check(record, hidden, address(name), other)
    changed = "has changed since it was downloaded; delete it to download it again"
    _check(record, path, str(path), changed)
    if not record.exists():  # only now: the process may have been killed between the two
        write_text_atomic(record, msgspec.json.encode(_facts(path)).decode())
    return path


def address(name: str) -> str:
    """Returns the URL of a data set, over https, which D4RL's host supports.

    Args:
        name: one of D4RL's names.

    Example:
        >>> address("hopper-medium-v2")
        'https://rail.eecs.berkeley.edu/datasets/offline_rl/gym_mujoco_v2/hopper_medium-v2.hdf5'
    """
    url = D4RL_DATASETS[name]
    return url.replace("http://", "https://", 1) if urlsplit(url).hostname == _HOST else url


def _cache_folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base, "torchrl-tit", "d4rl")


def _download(url: str, path: Path) -> None:
    open_file = h5py.File  # first: without h5py, nothing is downloaded
    try:
        with urllib.request.urlopen(url, timeout=_TIMEOUT) as answer, path.open("wb") as file:
            if urlsplit(url).scheme == "https" != urlsplit(answer.url).scheme:
                raise OSError(f"it was redirected to {answer.url}, which is not https")
            while block := answer.read(_BLOCK):
                file.write(block)
            expected = answer.headers.get("Content-Length")
    except (URLError, OSError) as error:
        raise OSError(f"{url} cannot be downloaded: {error}") from error
    if expected is not None and path.stat().st_size != int(expected):
        raise OSError(f"{url}: received only {path.stat().st_size} of {expected} bytes; try again.")
    with damage_named(url, "is not a whole HDF5 file"):
        open_file(path, "r").close()


class _Facts(msgspec.Struct):
    """Identifies a file."""

    bytes: int
    sha256: str


def _facts(path: Path) -> _Facts:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return _Facts(path.stat().st_size, digest)


def _check(record: Path, path: Path, source: str, problem: str) -> None:
    """Raises DatasetError if there is a record and the file does not match it."""
    if not record.exists():
        return
    try:
        before = msgspec.json.decode(record.read_bytes(), type=_Facts)
    except ValueError as error:
        raise DatasetError(str(record), f"is damaged ({error}); delete it.") from error
    if before != (now := _facts(path)):
        raise DatasetError(
            source,
            f"{problem} ({now.bytes} bytes with the SHA-256 {now.sha256}, not {before.bytes} with "
            f"{before.sha256}).",
        )
