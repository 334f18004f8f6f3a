"""Recipes in a Python file, which is run to read them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType
from typing import Any

from torchrl_tit.settings.checks import nearest
from torchrl_tit.settings.imports import import_allowed

from .recipe import Recipe


def is_recipe_file(source: str) -> bool:
    """Whether a name on the command line is a Python file, or ``FILE:NAME`` of a recipe in one.

    Example:
        >>> is_recipe_file("my_recipes.py:small"), is_recipe_file("ppo/cartpole/mlp")
        (True, False)
    """
    return source.endswith(".py") or ".py:" in source


def recipes_from_file(source: str) -> dict[str, Recipe]:
    """Runs a Python file and takes the recipes that it defines.

    These are its variables that are recipes, and the entries of those that are dictionaries of
    recipes; names that begin with "_" are left out. A recipe without a name is given that of its
    variable or entry.

    Args:
        source: a Python file, or ``FILE:NAME`` of one of its recipes.

    Returns:
        Each recipe by the source that identifies it, ``FILE:NAME``.

    Raises:
        ImportError: if there is no such file, it is not Python, or it raises.
        ValueError: if it defines no recipe, or none of that name.
    """
    file, _, name = source.partition(".py:")
    file = file if file.endswith(".py") else f"{file}.py"
    recipes = dict(_recipes(import_allowed(file)))
    if not recipes:
        raise ValueError(
            f"{file} defines no recipe: assign one, such as PPO(...), or a dictionary of recipes, "
            "to a variable"
        )
    if name and name not in recipes:
        raise ValueError(f"{file} defines no recipe {name!r}: {nearest(name, recipes)}")
    return {
        f"{file}:{key}": recipe if recipe.name else replace(recipe, name=key)
        for key, recipe in recipes.items()
        if not name or key == name
    }


def recipe_from_file(source: str) -> Recipe:
    """Runs a Python file and takes the recipe that it defines, or the one that is named.

    Raises:
        ImportError: as :func:`recipes_from_file`.
        ValueError: as :func:`recipes_from_file`, and if it defines several and none is named.
    """
    recipes = recipes_from_file(source)
    if len(recipes) > 1:
        raise ValueError(f"{source} defines {len(recipes)} recipes: name {' or '.join(recipes)}")
    return next(iter(recipes.values()))


def _recipes(module: ModuleType) -> Iterator[tuple[str, Recipe]]:
    for name, value in vars(module).items():
        values: dict[Any, Any] = value if isinstance(value, dict) else {name: value}
        for key, recipe in values.items() if not name.startswith("_") else ():
            if isinstance(recipe, Recipe):
                yield key, recipe
