"""Search spaces as data: the fields of a recipe that are searched, and their ranges."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import msgspec
import optuna

from torchrl_tit.settings import Inner
from torchrl_tit.settings.checks import nearest
from torchrl_tit.settings.histories import OuterSettings

from ..recipe import Recipe
from ..recipe_json import recipe_from_json, recipe_to_json

Number = float | int

# Fields that define the search, which therefore cannot vary them. A search has its own seeds.
_FIXED = {"algorithm", "name", "seed"}


class Categorical(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag="categorical"):
    """One of several values."""

    choices: Annotated[list[str | bool | int | float | None], msgspec.Meta(min_length=1)]

    def suggest(self, trial: optuna.Trial, field: str) -> Any:
        """Asks Optuna for a value."""
        return trial.suggest_categorical(field, self.choices)

    def contains(self, value: Any) -> bool:
        """Whether this is one of the values."""
        return value in self.choices

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
        """Asks Optuna for a value."""
        return trial.suggest_float(field, self.low, self.high, log=self.log)

    def contains(self, value: Any) -> bool:
        """Whether this is a number between the bounds."""
        return isinstance(value, Number) and self.low <= value <= self.high

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
            raise ValueError("log requires a step of 1")

    def suggest(self, trial: optuna.Trial, field: str) -> Any:
        """Asks Optuna for a value."""
        return trial.suggest_int(field, self.low, self.high, step=self.step, log=self.log)

    def contains(self, value: Any) -> bool:
        """Whether this is one of the whole numbers between the bounds."""
        return value in range(self.low, self.high + 1, self.step)

    def examples(self) -> list[Any]:
        """Both bounds."""
        return [self.low, self.high]


SearchSpace = dict[str, Categorical | Float | Int]
"""Ranges by the full name of a field, such as "backbone.frame.patch_size"."""


def load_space(source: Path | None, recipe: Recipe) -> SearchSpace:
    """Reads a search space, or chooses the one that comes with the library for a recipe.

    Args:
        source: a JSON file, such as
            ``{"learning_rate": {"type": "float", "low": 1e-5, "high": 1e-3, "log": true}}``.
        recipe: the recipe whose fields are searched.

    Raises:
        ValueError: if it is not a search space, or names a field or a value that the recipe
            rejects.
    """
    if source is None:
        text = resources.files(__package__).joinpath("search_spaces.json").read_bytes()
        spaces = msgspec.json.decode(text, type=dict[str, SearchSpace])
        name = _default_space(recipe)
        space = spaces[name] | spaces.get(f"{name}/{recipe.backbone.history.name}", {})
        source = Path(f"the search space {name!r}")
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
    """Returns a recipe with other values in some fields.

    Args:
        recipe: the recipe.
        values: the values, by the full name of a field, such as "backbone.frame.patch_size".
        source: where they come from, for messages.

    Raises:
        ValueError: if there is no such field, or the recipe rejects a value.

    Example:
        >>> from recipes.registry import get_recipe
        >>> recipe = get_recipe("ppo/cartpole/enhanced-tit")
        >>> with_values(recipe, {"backbone.frame.embed_dim": 64}, Path("here")).backbone.frame
        Inner(num_heads=1, ...embed_dim=64...)
    """
    fields = json.loads(recipe_to_json(recipe))
    owners = {
        name: owner
        for name, owner in _owners(fields).items()
        if name not in _FIXED and not name.endswith(".encoder")
    }
    for name, value in values.items():
        if name not in owners:
            raise ValueError(
                f"{source} searches the unknown field {name!r}: {nearest(name, owners)}"
            )
        owners[name][name.rpartition(".")[2]] = value
    return recipe_from_json(json.dumps(fields), source)


def _owners(fields: dict[str, Any], prefix: str = "") -> dict[str, dict[str, Any]]:
    """The dictionary that holds a field, by the field's full name."""
    owners: dict[str, dict[str, Any]] = {}
    for name, value in fields.items():
        nested = isinstance(value, dict)
        owners |= _owners(value, f"{prefix}{name}.") if nested else {prefix + name: fields}
    return owners


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


def _check_bounds(low: Number, high: Number, log: bool) -> None:
    if not low < high:
        raise ValueError(f"low must be below high, not {low} and {high}")
    if log and low <= 0:
        raise ValueError(f"low must be above 0 where log is on, not {low}")
