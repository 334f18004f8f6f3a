"""Processes that begin at once, without the seconds that importing PyTorch takes.

Each is forked from a server that has imported everything already. Like a spawned process, it knows
nothing of what the tests have done but their environment variables, and draws random numbers of its
own.
"""

import multiprocessing
import os
import random
import resource
from collections.abc import Iterator, Mapping
from contextlib import chdir, contextmanager
from multiprocessing import forkserver, spawn
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
PRELOADED = [
    __name__,
    "matplotlib.pyplot",
    "pytest",
    "recipes.cli.main",
    "recipes.ppo",
    "recipes.tools.results.plot",
    "recipes.core.runner",
    "torch.utils.tensorboard",
]
_describe, _prepare, _ensure_running = (
    spawn.get_preparation_data,
    spawn.prepare,
    forkserver._forkserver.ensure_running,
)


def use_server() -> None:
    """Makes this the way in which every process begins that Python's multiprocessing starts."""
    multiprocessing.set_start_method("forkserver", force=True)
    multiprocessing.set_forkserver_preload(PRELOADED)


def describe(name: str) -> dict[str, Any]:
    return {**_describe(name), "environment": dict(os.environ)}


def prepare(data: Mapping[str, Any]) -> None:
    os.environ.clear()
    os.environ.update(data["environment"])
    random.seed()
    np.random.seed()
    _prepare(data)


def ensure_running() -> None:
    """The server imports from its current folder, which a test may have changed by then."""
    with chdir(ROOT):
        _ensure_running()


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """No file grows beyond a number of bytes, as on a disk that is full then."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


# Here rather than in a function, since the server does no more than to import this.
spawn.get_preparation_data = describe
spawn.prepare = prepare
forkserver._forkserver.ensure_running = ensure_running  # type: ignore[method-assign]
