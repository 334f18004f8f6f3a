"""Search spaces as data: which fields of a recipe are searched, and where."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec

from torchrl_tit.networks import EnhancedTITConfig, VanillaTITConfig

from ..recipe import Recipe, nearest, recipe_from_json, recipe_to_json

if TYPE_CHECKING:
    import optuna

Number = float | int

# What a search is of, not what it searches; it has seeds of its own.
_FIXED = {"algorithm", "name", "seed", "backbone", "backbone.network"}


class Categorical(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="categorical"):
    """One of several values."""

    choices: Annotated[list[str | bool | int | float | None], msgspec.Meta(min_length=1)]

    def suggest(self, trial: optuna.Trial, field: str) -> Any:
        """Asks for a value."""
        return trial.suggest_categorical(field, self.choices)

    def examples(self) -> list[Any]:
        """All values."""
        return list(self.choices)


class Float(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="float"):
    """A number between two bounds."""

    low: float
    high: float
    log: bool = False

    def __post_init__(self) -> None:
        _check_bounds(self.low, self.high, self.log)

    def suggest(self, trial: optuna.Trial, field: str) -> Any:
        """Asks for a value."""
        return trial.suggest_float(field, self.low, self.high, log=self.log)

    def examples(self) -> list[Any]:
        """Both bounds."""
        return [self.low, self.high]


class Int(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="int"):
    """A whole number between two bounds."""

    low: int
    high: int
    step: Annotated[int, msgspec.Meta(ge=1)] = 1
    log: bool = False

    def __post_init__(self) -> None:
        _check_bounds(self.low, self.high, self.log)
        if self.log and self.step != 1:
            raise ValueError("log goes with a step of 1 only")

    def suggest(self, trial: optuna.Trial, field: str) -> Any:
        """Asks for a value."""
        return trial.suggest_int(field, self.low, self.high, step=self.step, log=self.log)

    def examples(self) -> list[Any]:
        """Both bounds."""
        return [self.low, self.high]


SearchSpace = dict[str, Categorical | Float | Int]
"""Ranges by field; a network's fields begin with "backbone."."""


def load_space(source: Path | None, recipe: Recipe) -> SearchSpace:
    """Reads a search space, or chooses the one that comes with the library for a recipe.

    Args:
        source: a JSON file, such as
            ``{"learning_rate": {"type": "float", "low": 1e-5, "high": 1e-3, "log": true}}``.
        recipe: the recipe whose fields are searched.

    Raises:
        ValueError: if it is no search space, or names a field or a value that the recipe refuses.
    """
    if source is None:
        text = resources.files(__package__).joinpath("search_spaces.json").read_bytes()
        spaces = msgspec.json.decode(text, type=dict[str, SearchSpace])
        name = _default_space(recipe)
        space, source = spaces[name], Path(f"the search space {name!r}")
    else:
        try:
            space = msgspec.json.decode(source.read_bytes(), type=SearchSpace)
        except msgspec.MsgspecError as error:
            raise ValueError(f"{source} is not a search space: {error}") from error
    if not space:
        raise ValueError(f"{source} names no field to search")
    for field, values in space.items():
        for value in values.examples():
            with_values(recipe, {field: value}, source)
    return space


def with_values(recipe: Recipe, values: Mapping[str, Any], source: Path) -> Recipe:
    """A recipe with other values in some fields.

    Args:
        recipe: the recipe.
        values: by field; a network's fields begin with "backbone.".
        source: where they come from, for messages.

    Raises:
        ValueError: if there is no such field, or the recipe refuses a value.

    Example:
        >>> from recipes.registry import get_recipe
        >>> recipe = get_recipe("ppo/cartpole/enhanced-tit")
        >>> with_values(recipe, {"backbone.embed_dim": 64}, Path("here")).backbone.embed_dim
        64
    """
    fields = json.loads(recipe_to_json(recipe))
    names = [*fields, *(f"backbone.{name}" for name in fields["backbone"])]
    known = dict.fromkeys(name for name in names if name not in _FIXED)
    for name, value in values.items():
        if name not in known:
            raise ValueError(
                f"{source} searches the unknown field {name!r}: {nearest(name, known)}"
            )
        prefix, _, field = name.rpartition(".")
        (fields[prefix] if prefix else fields)[field] = value
    return recipe_from_json(json.dumps(fields), source)


def _default_space(recipe: Recipe) -> str:
    if recipe.algorithm != "ppo":
        raise ValueError(
            f"no search space comes with the algorithm {recipe.algorithm}: write one and name it "
            "with --space (docs/recipes.md shows how)"
        )
    if not isinstance(recipe.backbone, EnhancedTITConfig | VanillaTITConfig):
        return "ppo"
    return "tit-images" if getattr(recipe, "env", "").startswith("ALE/") else "tit-arrays"


def _check_bounds(low: Number, high: Number, log: bool) -> None:
    if not low < high:
        raise ValueError(f"low must be below high, not {low} and {high}")
    if log and low <= 0:
        raise ValueError(f"low must be above 0 where log is on, not {low}")
