"""Recipes as JSON."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from torchrl_tit.settings import FrameSettings, HistorySettings, Part
from torchrl_tit.settings.checks import checked, field_types, nearest

from .recipe import Recipe, get_recipe_class
from .trust import check_names

T = TypeVar("T")

_ENCODER = "encoder"
"""The entry that names the frame or history encoder; the others are its settings."""


def recipe_to_json(recipe: Recipe) -> str:
    """Writes a recipe as JSON, which :func:`recipe_from_json` reads back."""
    fields = {"algorithm": recipe.algorithm, **settings_to_dict(recipe)}
    return json.dumps(fields, indent=2) + "\n"


def settings_to_dict(settings: Any) -> dict[str, Any]:
    """Turns nested settings into dictionaries, with the name of a part under "encoder"."""
    fields = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    values = {name: _to_json(value) for name, value in fields.items()}
    return {_ENCODER: settings.name, **values} if isinstance(settings, Part) else values


def _to_json(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: settings_to_dict(part) for key, part in value.items()}
    return settings_to_dict(value) if dataclasses.is_dataclass(value) else value


def recipe_from_json(text: str | bytes, source: str | Path) -> Recipe:
    """Makes a recipe from JSON.

    Args:
        text: what :func:`recipe_to_json` wrote; fields that are missing take their defaults.
        source: the file it came from, for messages.

    Raises:
        ValueError: if it is not JSON, a field is unknown or has the wrong type or value, or it
            names what a file may not name (:mod:`recipes.core.trust`).
    """
    try:
        fields = json.loads(text)
        if not isinstance(fields, dict):
            raise ValueError("expected an object with the recipe's fields")
        kind = get_recipe_class(fields.pop("algorithm", None))
        recipe = _convert(kind, fields)
    except (RecursionError, ValueError) as error:  # json.JSONDecodeError is one
        raise ValueError(f"{source} cannot be read as a recipe: {error}") from error
    check_names(recipe, source)
    return recipe


def _convert(kind: type[T], fields: Any, prefix: str = "") -> T:
    """Builds settings from a dictionary; each value must have exactly its field's type."""
    if not isinstance(fields, dict):
        raise ValueError(f"field {prefix[:-1]!r}: expected an object, not {fields!r}")
    types, removed = field_types(kind), getattr(kind, "removed", {})
    values = {}
    for name, value in fields.items():
        if name in removed:
            if value != removed[name]:
                raise ValueError(
                    f"field {prefix + name!r} no longer exists, and only {removed[name]!r} can be "
                    "read, which changes nothing: leave it out"
                )
            continue
        if name not in types:
            raise ValueError(f"unknown field {prefix + name!r}: {nearest(name, types)}")
        values[name] = _READERS.get(types[name], _convert_value)(types[name], value, prefix + name)
    try:
        return kind(**values)
    except TypeError as error:  # a field without a default is missing
        missing = str(error).rpartition(": ")[2] or str(error)
        raise ValueError(f"{prefix[:-1] or 'it'} lacks the field {missing}") from error


def _convert_value(kind: Any, value: Any, name: str) -> Any:
    if dataclasses.is_dataclass(kind):
        return _convert(kind, value, f"{name}.")  # type: ignore[arg-type]
    return checked(name, value, kind)


def _convert_part(kind: type[Part], value: Any, name: str) -> Part:
    if not isinstance(value, dict):
        raise ValueError(f"field {name!r}: expected an object, not {value!r}")
    fields = dict(value)
    try:
        part = kind.get(fields.pop(_ENCODER, None))
    except ValueError as error:
        raise ValueError(f"field {name + '.' + _ENCODER!r}: {error}") from error
    return _convert(part, part.from_older(fields), f"{name}.")


def _convert_parts(kind: Any, value: Any, name: str) -> dict[str, Part]:
    if not isinstance(value, dict):
        raise ValueError(f"field {name!r}: expected an object, not {value!r}")
    return {key: _convert_part(FrameSettings, part, f"{name}.{key}") for key, part in value.items()}


_READERS: dict[Any, Callable[[Any, Any, str], Any]] = {
    FrameSettings: _convert_part,
    Mapping[str, FrameSettings]: _convert_parts,
    HistorySettings: _convert_part,
}
