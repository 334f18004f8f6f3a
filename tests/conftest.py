"""Settings of the whole suite.

PyTorch is imported where it is used: the process that deals the tests out to others needs it not.
"""

import gc
import os
import platform
import random
import signal
import sys
from collections.abc import Generator, Iterator
from copy import deepcopy
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from recipes.core.recipe import Recipe
from recipes.core.registry import RECIPES
from tests import processes
from torchrl_tit.settings import FrameSettings, HistorySettings, imports
from torchrl_tit.settings.parts import Names

# Small networks gain nothing from threads, and parallel test workers would fight over the cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# As the command line sets it, before TorchRL is imported.
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")

processes.use_server()

# A shell that starts the suite in the background ignores Ctrl-C, which tests of it do not expect.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish() -> None:
    """What was imported stays: the garbage collector need not look through it in each test."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)


SEED = int(os.environ.get("TEST_SEED", "0"))


@pytest.fixture(autouse=True)
def _seed() -> None:
    """A test draws the same numbers whichever tests ran before it."""
    import torch

    random.seed(SEED)
    np.random.seed(SEED)
    torch.manual_seed(SEED)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A failing test says what it ran with, so that it can be run so again."""
    report = yield
    if report.failed:
        report.sections.append(("what it ran with", "\n".join(_describe(item))))
    return report


def _describe(item: pytest.Item) -> Iterator[str]:
    import torch

    for name, value in item.callspec.params.items() if hasattr(item, "callspec") else ():
        yield f"{name} = {value!r}"
    yield f"TEST_SEED={SEED} ATEN_CPU_CAPABILITY={torch.backends.cpu.get_cpu_capability()}"
    yield f"{torch.get_num_threads()} threads, {torch.get_default_dtype()}"
    packages = [
        f"{name} {version(name)}" for name in ("torch", "torchrl", "tensordict", "gymnasium")
    ]
    yield ", ".join([f"Python {platform.python_version()}", *packages])


@pytest.fixture(autouse=True)
def _imports(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test allows to be imported stays its own."""
    monkeypatch.setenv("TORCHRL_TIT_IMPORTS", "")


@pytest.fixture
def float64() -> Iterator[None]:
    """Networks and inputs are made in float64, where rounding hides no mistake."""
    import torch

    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


@pytest.fixture
def own_modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A current directory for modules of a user's own; what they register is forgotten again."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    monkeypatch.setattr(imports, "_failures", None)
    list(RECIPES.values())  # imports every algorithm, which would be forgotten, too
    tables: list[Names[Any]] = [FrameSettings.registered, HistorySettings.registered]
    tables += [Recipe.registered, RECIPES.names]
    before = [(dict(table), deepcopy(vars(table))) for table in tables]
    tasks, modules = set(gymnasium.registry), set(sys.modules)
    yield tmp_path
    for table, (entries, attributes) in zip(tables, before, strict=True):
        table.clear()
        table.update(entries)
        vars(table).update(attributes)
    for task in set(gymnasium.registry) - tasks:
        del gymnasium.registry[task]
    for name in set(sys.modules) - modules:
        if str(getattr(sys.modules[name], "__file__", "")).startswith(str(tmp_path)):
            del sys.modules[name]
