"""Experiments: settings, algorithms, one training loop, and a command line.

When installed, this package is named ``torchrl_tit.recipes``; import it by that name.
"""

from __future__ import annotations

import importlib
import os
from typing import Any

from .core.package_alias import share_modules

os.environ.setdefault("RAY_AUTH_MODE", "token")  # here: Ray reads it when TorchRL imports it
share_modules(__name__)

_HOMES = {
    "Algorithm": "core.algorithm",
    "Callback": "core.callback",
    "DatasetAlgorithm": "offline",
    "DatasetRecipe": "core.recipe",
    "NotFiniteError": "core.algorithm",
    "Outcome": "core.evaluation",
    "Recipe": "core.recipe",
    "Run": "core.run",
    "check_finite": "core.algorithm",
    "evaluate": "core.runner",
    "find_recipe": "core.registry",
    "get_recipe": "core.registry",
    "load_trained": "core.runner",
    "make_algorithm": "core.algorithm",
    "make_task": "core.task",
    "recipe_from_json": "core.recipe_json",
    "recipe_to_json": "core.recipe_json",
    "register_recipes": "core.registry",
    "seed_copies": "core.task",
    "train": "core.runner",
    "weights_from": "core.initial_weights",
}
"""The modules of the public names; PyTorch is loaded with the first name that needs it."""

__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
