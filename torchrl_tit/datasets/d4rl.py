"""Downloads D4RL's data sets."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import urllib.request
from pathlib import Path
from urllib.error import URLError

import h5py
from torchrl.data.datasets.d4rl_infos import D4RL_DATASETS

from torchrl_tit.datasets.errors import DatasetError
from torchrl_tit.files import whole_or_not_at_all, write_text_atomic

_BLOCK = 2**20
_TIMEOUT = 60  # seconds without an answer


def download_d4rl(name: str, cache_dir: str | os.PathLike[str] | None = None) -> Path:
    """Downloads one of D4RL's data sets, unless it has been downloaded before.

    Files are written atomically. D4RL publishes no checksums, so a download must have the length
    that the server states and be a whole HDF5 file. Its checksum is stored beside it, and verified
    whenever the file is used again.

    Args:
        name: D4RL's name, such as "hopper-medium-replay-v0" or "hopper-medium-v2".
        cache_dir: Folder for the files; by default "torchrl-tit/d4rl" in the user's cache folder
            (``$XDG_CACHE_HOME``, or ``~/.cache``).

    Returns:
        The file.

    Raises:
        ValueError: If D4RL has no data set of that name.
        OSError: If it cannot be downloaded or written.
        DatasetError: If the file is damaged.

    Source: D4RL (arXiv 2004.07219); the URLs are those of TorchRL.

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
        record.unlink(missing_ok=True)
        # If another process was faster, its download is used.
        with contextlib.suppress(FileExistsError), whole_or_not_at_all(path) as hidden:
            _download(D4RL_DATASETS[name], hidden)
    if not record.exists():  # the process may have been killed between the two
        write_text_atomic(record, json.dumps(_facts(path)))
    if json.loads(record.read_text(encoding="utf-8")) != _facts(path):
        raise DatasetError(
            str(path), "has changed since it was downloaded; delete it to download it again."
        )
    return path


def _cache_folder() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base, "torchrl-tit", "d4rl")


def _download(url: str, path: Path) -> None:
    try:
        with urllib.request.urlopen(url, timeout=_TIMEOUT) as answer, path.open("wb") as file:
            while block := answer.read(_BLOCK):
                file.write(block)
            expected = answer.headers.get("Content-Length")
    except (URLError, OSError) as error:
        raise OSError(f"{url} cannot be downloaded: {error}") from error
    if expected is not None and path.stat().st_size != int(expected):
        raise OSError(f"{url}: received only {path.stat().st_size} of {expected} bytes; try again.")
    try:
        h5py.File(path, "r").close()
    except OSError as error:
        raise DatasetError(url, f"is not a whole HDF5 file ({error}).") from error


def _facts(path: Path) -> dict[str, str | int]:
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"bytes": path.stat().st_size, "sha256": digest}
