"""The named recipes: the paper's experiments as data."""

from __future__ import annotations

from pathlib import Path

from torchrl_tit.settings.checks import nearest

from .presets.cql import CQL_RECIPES
from .presets.decision_transformer import DT_RECIPES
from .presets.ppo_arrays import ARRAY_RECIPES
from .presets.ppo_atari import ATARI_RECIPES
from .presets.ppo_no_velocity import NO_VELOCITY_RECIPES
from .presets.sac import SAC_RECIPES
from .recipe import Recipe
from .recipe_json import recipe_from_json

RECIPES: dict[str, Recipe] = {
    **ARRAY_RECIPES,
    **NO_VELOCITY_RECIPES,
    **ATARI_RECIPES,
    **SAC_RECIPES,
    **CQL_RECIPES,
    **DT_RECIPES,
}
"""Every named recipe."""


def get_recipe(name: str) -> Recipe:
    """Looks up a recipe.

    Raises:
        ValueError: if no recipe has that name; the message suggests similar names.

    Example:
        >>> get_recipe("ppo/cartpole/enhanced-tit").env
        'CartPole-v1'
    """
    if name not in RECIPES:
        raise ValueError(f"unknown recipe {name!r}: {nearest(name, RECIPES)}")
    return RECIPES[name]


def find_recipe(name: str) -> Recipe:
    """Looks up a recipe by name, or reads it from a JSON file such as a run's ``recipe.json``.

    Raises:
        ValueError: if no recipe has that name, the file holds no recipe, or it is a folder.
        FileNotFoundError: if there is no such file.

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
        return recipe_from_json(path.read_bytes(), path)
    return get_recipe(name)
