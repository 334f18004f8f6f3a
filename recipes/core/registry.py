"""Recipes by name, the paper's and those of users' packages, and recipes in files."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

from torchrl_tit.settings.checks import nearest
from torchrl_tit.settings.imports import import_allowed
from torchrl_tit.settings.parts import Names

from ..presets.preset import Preset
from .recipe import Recipe, get_recipe_class
from .recipe_json import recipe_from_json
from .records import find_records


class NamedRecipes(Mapping[str, Recipe]):
    """Recipes by name; those of this package are made, and PyTorch imported, when they are taken.

    Example:
        >>> RECIPES["ppo/cartpole/enhanced-tit"].env
        'CartPole-v1'
    """

    def __init__(self) -> None:
        self.names: Names[Recipe | Preset] = Names("recipe")

    def add(self, recipe: Recipe | Preset, home: str) -> None:
        """Adds a recipe; see :meth:`Names.add`."""
        self.names.add(recipe.name, recipe, home)

    def find(self, name: str) -> Recipe:
        """Looks up a recipe, also in plugins; see :meth:`Names.find`."""
        self.names.find(name)
        return self[name]

    def __getitem__(self, name: str) -> Recipe:
        recipe = self.names[name]
        if isinstance(recipe, Preset):
            recipe = self.names[name] = get_recipe_class(recipe.algorithm)(**recipe.fields)
        return recipe

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)


RECIPES = NamedRecipes()
"""Every named recipe."""


def register_recipes(*recipes: Recipe) -> None:
    """Adds named recipes, which ``list`` prints and every command takes by name.

    Call it in the module that ``--import``, or the entry point of your own package, names.

    Raises:
        ValueError: if a recipe has no name, or the name of a recipe from another module.

    Example:
        >>> from dataclasses import replace
        >>> register_recipes(replace(get_recipe("ppo/cartpole/mlp"), name="mine/first"))
        >>> get_recipe("mine/first").env
        'CartPole-v1'
    """
    home = sys._getframe(1).f_globals["__name__"]  # the calling module, for messages
    for recipe in recipes:
        if not recipe.name:
            raise ValueError(
                "a recipe needs a name to be registered: set its field 'name', such as "
                "ppo/cartpole/mine"
            )
        RECIPES.add(recipe, home)


_PRESETS = (
    *("ppo_any_task", "any_data", "ppo_arrays", "ppo_no_velocity", "ppo_memory", "ppo_atari"),
    *("ppo_minatar", "sac", "dqn", "cql", "offline", "decision_transformer"),
)
"""The modules of this package's named recipes, in the order in which ``list`` prints them."""

for _module in _PRESETS:
    for _preset in importlib.import_module(f"..presets.{_module}", __package__).RECIPES:
        RECIPES.add(_preset, __name__)


def get_recipe(name: str) -> Recipe:
    """Looks up a recipe, including those of installed plugins.

    Raises:
        ValueError: if no recipe, or more than one, has that name; the message suggests similar
            names.

    Example:
        >>> get_recipe("ppo/cartpole/enhanced-tit").env
        'CartPole-v1'
    """
    return RECIPES.find(name)


def find_recipe(name: str) -> Recipe:
    """Looks up a recipe by name, or reads it from a file.

    Args:
        name: the name; a JSON file such as a run's ``recipe.json``, also of a run that a table of
            runs holds; or a Python file, which is run, as ``FILE.py`` or ``FILE.py:NAME``.

    Raises:
        ValueError: if no recipe has that name, the file holds no recipe or several, or it is a
            folder.
        FileNotFoundError: if there is no such JSON file.
        ImportError: if the Python file cannot be run.

    Example:
        >>> find_recipe("ppo/pong/enhanced-tit").env
        'ALE/Pong-v5'
    """
    path = Path(name)
    if path.is_dir():
        raise ValueError(
            f"{name} is a folder, not a recipe: name the recipe.json in it, or resume the run with "
            f"`train --resume {name}`"
        )
    if path.suffix == ".json":
        if (found := find_records(path.parent)) and found[1] in found[0].rows:
            records, run = found
            return recipe_from_json(records.read(run, path.name) or b"", path)
        return recipe_from_json(path.read_bytes(), path)
    if not is_recipe_file(name):
        return get_recipe(name)
    recipes = recipes_from_file(name)
    if len(recipes) > 1:
        raise ValueError(f"{name} defines {len(recipes)} recipes: name {' or '.join(recipes)}")
    return next(iter(recipes.values()))


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


def _recipes(module: ModuleType) -> Iterator[tuple[str, Recipe]]:
    for name, value in vars(module).items():
        values: dict[Any, Any] = value if isinstance(value, dict) else {name: value}
        for key, recipe in values.items() if not name.startswith("_") else ():
            if isinstance(recipe, Recipe):
                yield key, recipe
