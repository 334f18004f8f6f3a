"""Settings of the whole suite."""

import os
import signal
import sys
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import gymnasium
import pytest
import torch

from recipes.recipe import Recipe
from recipes.registry import RECIPES
from torchrl_tit.settings import FrameSettings, HistorySettings, plugins
from torchrl_tit.settings.names import Names

# Small networks gain nothing from threads, and parallel test workers would fight over the cores.
if "OMP_NUM_THREADS" not in os.environ:
    torch.set_num_threads(1)


# A shell that starts the suite in the background ignores Ctrl-C, which tests of it do not expect.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def _seed() -> None:
    """A test draws the same numbers whichever tests ran before it."""
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def _imports(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test allows to be imported stays its own."""
    monkeypatch.setenv("TORCHRL_TIT_IMPORTS", "")


@pytest.fixture
def float64() -> Iterator[None]:
    """Networks and inputs are made in float64, where rounding hides no mistake."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


@pytest.fixture
def own_modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A current directory for modules of a user's own; what they register is forgotten again."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", sys.path[:])
    monkeypatch.setattr(plugins, "_failures", None)
    tables: list[Names[Any]] = [FrameSettings.registered, HistorySettings.registered]
    tables += [Recipe.registered, RECIPES]
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
