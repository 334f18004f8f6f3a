"""Search spaces as data: the fields of a recipe that are searched, and their ranges."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Any, TypeAlias

from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)

from torchrl_tit.settings import Inner
from torchrl_tit.settings.checks import nearest
from torchrl_tit.settings.encoders import OuterSettings

from ...core.recipe import Recipe
from ...core.recipe_json import recipe_from_json, recipe_to_json

SearchSpace: TypeAlias = dict[str, dict[str, Any]]
"""Ranges by the full name of a field, such as "backbone.frame.patch_size": the "type" of an Optuna
distribution and its arguments, as in ``{"type": "float", "low": 1e-5, "high": 1e-3, "log": true}``.
"""

_KINDS: dict[str, type[BaseDistribution]] = {
    "categorical": CategoricalDistribution,
    "float": FloatDistribution,
    "int": IntDistribution,
}
# Fields that define the search, which therefore cannot vary them. A search has its own seeds, and
# trials are comparable if they were evaluated in the same way.
_FIXED = {"algorithm", "name", "seed", "evaluation_seed", "evaluation_episodes"}
_TASK = {"env", "env_settings", "wrappers", "hide_velocities", "dataset"}


def load_space(source: Path | None, recipe: Recipe) -> SearchSpace:
    """Reads a search space, or chooses the one that comes with the library for a recipe.

    Args:
        source: a JSON file with a :data:`SearchSpace`.
        recipe: the recipe whose fields are searched.

    Raises:
        ValueError: if it is not a search space, or names a field or a value that the recipe
            rejects.
    """
    if source is None:
        spaces = json.loads(resources.files(__package__).joinpath("search_spaces.json").read_text())
        name = _default_space(recipe)
        space = spaces[name] | spaces.get(f"{name}/{recipe.backbone.history.name}", {})
        source = Path(f"the search space {name!r}")
    else:
        try:
            space = json.loads(source.read_bytes())
            make_distributions(space)
        except (AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
            raise ValueError(f"{source} is not a search space: {error}") from error
    if not space:
        raise ValueError(f"{source} names no field to search")
    for field, arguments in space.items():
        values = arguments.get("choices") or (arguments["high"], arguments["low"])
        for value in values:
            # A float's ends need not be what lies between them.
            value = float(value) if arguments["type"] == "float" else value
            with_values(recipe, {field: value}, source)
        if field in _TASK:
            raise ValueError(
                f"{source} searches {field!r}, but trials on other tasks or data cannot be compared"
            )
    return space


def make_distributions(space: SearchSpace) -> dict[str, BaseDistribution]:
    """Makes Optuna's distributions of a search space, by the names of its fields.

    Example:
        >>> make_distributions({"epochs": {"type": "int", "low": 2, "high": 8}})
        {'epochs': IntDistribution(high=8, log=False, low=2, step=1)}
    """
    made = {}
    for field, arguments in space.items():
        if not isinstance(arguments, dict) or "type" not in arguments:
            raise ValueError(
                f'{field} has {arguments!r}, not a range such as {{"type": "int", "low": 2, '
                '"high": 8}'
            )
        kind = arguments["type"]
        if kind not in _KINDS:
            raise ValueError(f"the type of {field} is none of {', '.join(_KINDS)}")
        needed = ("choices",) if kind == "categorical" else ("low", "high")
        if lacking := [name for name in needed if name not in arguments]:
            raise ValueError(f"{field} has the type {kind}, but no {' and no '.join(lacking)}")
        if not isinstance(arguments.get("choices", []), list):
            raise ValueError(f"the choices of {field} are {arguments['choices']!r}, not a list")
        rest = {name: value for name, value in arguments.items() if name != "type"}
        try:
            made[field] = _KINDS[kind](**rest)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{field}: {error}") from error
    return made


def with_values(recipe: Recipe, values: Mapping[str, Any], source: Path) -> Recipe:
    """Returns a recipe with other values in some fields.

    Args:
        recipe: the recipe.
        values: the values, by the full name of a field, such as "backbone.frame.patch_size".
        source: where they come from, for messages.

    Raises:
        ValueError: if there is no such field, or the recipe rejects a value.

    Example:
        >>> from recipes.core.registry import get_recipe
        >>> recipe = get_recipe("ppo/cartpole/enhanced-tit")
        >>> with_values(recipe, {"backbone.frame.embed_dim": 64}, Path("here")).backbone.frame
        Inner(num_heads=1, ...embed_dim=64...)
    """
    fields = json.loads(recipe_to_json(recipe))
    owners = {
        name: owner
        for name, owner in _owners(fields)
        if name not in _FIXED and not name.endswith(".encoder")
    }
    for name, value in values.items():
        if name not in owners:
            raise ValueError(
                f"{source} searches the unknown field {name!r}: {nearest(name, owners)}"
            )
        owners[name][name.rpartition(".")[2]] = value
    return recipe_from_json(json.dumps(fields), source)


def _owners(fields: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    """Yields each field's full name and the dictionary that holds it."""
    for name, value in fields.items():
        if isinstance(value, dict):
            yield from _owners(value, f"{prefix}{name}.")
        else:
            yield prefix + name, fields


def _default_space(recipe: Recipe) -> str:
    if recipe.algorithm != "ppo":
        raise ValueError(
            f"there is no default search space for the algorithm {recipe.algorithm}: write one and "
            "pass it with --space (docs/recipes.md shows how)"
        )
    network = recipe.backbone
    if not (isinstance(network.frame, Inner) and isinstance(network.history, OuterSettings)):
        return "ppo"
    return "tit-images" if recipe.env.startswith("ALE/") else "tit-arrays"
