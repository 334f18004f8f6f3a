"""Checks that each field of the settings has its declared type and lies within its bounds.

Bounds are part of the fields' types (:mod:`torchrl_tit.settings.numbers`), so that each field
declares in one place what it accepts. Every number must be finite.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import msgspec


def check_fields(settings: object) -> None:
    """Checks the type and the bounds of each field.

    Args:
        settings: a dataclass; nested dataclasses have already checked themselves.

    Raises:
        ValueError: if a field has the wrong type or is out of bounds.

    Example:
        >>> from torchrl_tit.settings import Inner
        >>> Inner(patch_size=2.5)
        Traceback (most recent call last):
            ...
        ValueError: field 'patch_size' is 2.5: Expected `int | str | null`, got `float`
        >>> Inner(num_heads=0)
        Traceback (most recent call last):
            ...
        ValueError: num_heads must be at least 1, not 0
    """
    for name, kind in field_types(type(settings)).items():
        value = getattr(settings, name)
        if is_dataclass(value):
            if isinstance(kind, type) and not isinstance(value, kind):
                raise ValueError(
                    f"field {name!r} must be settings of type {kind.__name__}, not "
                    f"{type(value).__name__}"
                )
        elif get_origin(kind) is not Mapping:  # PerKey has already checked its values
            checked(name, value, kind)


def field_types(kind: type) -> dict[str, Any]:
    """Returns the fields of a dataclass with their types, bounds included."""
    return _field_types(kind)


@cache
def _field_types(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind)}


def checked(name: str, value: object, kind: Any) -> Any:
    """Returns a value converted to a type.

    Args:
        name: the field's full name, for error messages.
        value: the value.
        kind: the type, with or without bounds.

    Raises:
        ValueError: if the value has the wrong type, is not finite or is out of bounds.

    Example:
        >>> from torchrl_tit.settings.numbers import Fraction
        >>> checked("gamma", 1, Fraction)
        1.0
        >>> checked("gamma", 1.5, Fraction)
        Traceback (most recent call last):
            ...
        ValueError: gamma must be at most 1, not 1.5
    """
    if is_dataclass(kind):
        raise ValueError(f"field {name!r} must be settings of a {_name(kind)}, not {value!r}")
    try:
        converted = msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise ValueError(_reason(name, value, kind, str(error))) from error
    parts = converted if isinstance(converted, tuple) else (converted,)
    if any(isinstance(part, float) and not math.isfinite(part) for part in parts):
        raise ValueError(f"{name} must be finite, not {value}")
    return converted


def _reason(name: str, value: object, kind: Any, error: str) -> str:
    """Says in plain words what is wrong with a value."""
    if isinstance(value, str) and (choices := tuple(_choices(kind))):
        return f"field {name!r} is {value!r}, not one of {choices}"
    for bounds in _bounds(kind):
        if bounds.description is not None and isinstance(value, int | float | list | tuple):
            return f"{name} must be {bounds.description}, not {value}"
        if not isinstance(value, int | float) or isinstance(value, bool):
            continue
        if bounds.gt == 0 and not value > 0:
            return f"{name} must be positive, not {value}"
        if bounds.ge is not None and not value >= bounds.ge:
            return f"{name} must be at least {bounds.ge}, not {value}"
        if bounds.le is not None and not value <= bounds.le:
            return f"{name} must be at most {bounds.le}, not {value}"
    return f"field {name!r} is {value!r}: {error}"


def _bounds(kind: Any) -> Iterator[msgspec.Meta]:
    """Yields the bounds in a type, the outermost first."""
    if get_origin(kind) is Annotated:
        yield from (extra for extra in kind.__metadata__ if isinstance(extra, msgspec.Meta))
    if get_origin(kind) is not Literal:
        for part in get_args(kind):
            yield from _bounds(part)


def _choices(kind: Any) -> Iterator[Any]:
    """Yields the values of the literals in a type."""
    if get_origin(kind) is Literal:
        yield from get_args(kind)
    else:
        for part in get_args(kind):
            yield from _choices(part)


def _name(kind: Any) -> str:
    return str(getattr(kind, "__name__", kind))
