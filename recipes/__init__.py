"""Experiments: settings, algorithms, one training loop, and a command line.

When installed, this package is named ``torchrl_tit.recipes``; import it by that name.
"""

from __future__ import annotations

import importlib
from typing import Any

from .one_name import share_modules

share_modules(__name__)

_HOMES = {
    "Algorithm": "algorithm",
    "Callback": "callback",
    "DatasetAlgorithm": "offline",
    "DatasetRecipe": "dataset_recipe",
    "NotFiniteError": "algorithm",
    "Outcome": "evaluation",
    "Recipe": "recipe",
    "Run": "run",
    "check_finite": "algorithm",
    "evaluate": "runner",
    "find_recipe": "registry",
    "get_recipe": "registry",
    "load_trained": "runner",
    "make_algorithm": "algorithm",
    "make_task": "task",
    "recipe_from_json": "recipe_json",
    "recipe_to_json": "recipe_json",
    "register_recipes": "registry",
    "seed_copies": "task",
    "train": "runner",
    "weights_from": "initial_weights",
}
"""The modules of the public names; PyTorch is loaded with the first name that needs it."""

__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOMES[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
