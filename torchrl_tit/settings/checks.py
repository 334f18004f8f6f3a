"""Checks values by their types, where they enter: fields of settings, and arguments of functions.

msgspec checks a value's type and bounds (:mod:`torchrl_tit.settings.numbers`), so that each field
and each argument declares in one place what it accepts. Every number must be finite.
"""

from __future__ import annotations

import difflib
import inspect
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache, wraps
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    ParamSpec,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec

P = ParamSpec("P")
R = TypeVar("R")
_PLAIN = (bool, float, int, str, NoneType)


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
        if is_dataclass(value) and isinstance(kind, type) and not isinstance(value, kind):
            raise ValueError(
                f"field {name!r} must be settings of type {kind.__name__}, not "
                f"{type(value).__name__}"
            )
        if not is_dataclass(value) and get_origin(kind) is not Mapping:
            checked(name, value, kind)


def field_types(kind: type) -> dict[str, Any]:
    """Returns the fields of a dataclass with their types, bounds included."""
    return _field_types(kind)


@cache
def _field_types(kind: type) -> dict[str, Any]:  # mypy takes classes for unhashable
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind)}


def checked_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """Makes a function check its arguments first, with an error message of one line.

    Arguments annotated as numbers, strings, choices (``Literal``) or unions of these are checked;
    others are left to the function.

    Args:
        function: the function whose arguments to check; for a class, its ``__init__``.

    Raises:
        ValueError: when the function is called, if an argument has the wrong type, is not finite or
            is out of bounds.

    Example:
        >>> from torchrl_tit.settings.numbers import Width
        >>> @checked_arguments
        ... def make_layer(width: Width, kind: Literal["plain", "gated"] = "plain"):
        ...     return width
        >>> make_layer(64)
        64
        >>> make_layer(0)
        Traceback (most recent call last):
            ...
        ValueError: width must be at least 1, not 0
    """
    signature = inspect.signature(function)

    @cache
    def kinds() -> dict[str, Any]:
        hints = get_type_hints(function, include_extras=True)
        return {name: kind for name, kind in hints.items() if name != "return" and _is_plain(kind)}

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError:
            return function(*args, **kwargs)  # raises Python's own error
        for name, kind in kinds().items():
            if name in given:
                value: Any = given[name]
                # NumPy's numbers are accepted like Python's.
                checked(name, value.item() if hasattr(value, "item") else value, kind)
        return function(*args, **kwargs)

    return call


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
        name_of_kind = getattr(kind, "__name__", kind)
        raise ValueError(f"field {name!r} must be settings of a {name_of_kind}, not {value!r}")
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
    literals = [part for part in _parts(kind) if get_origin(part) is Literal]
    if isinstance(value, str) and literals:
        choices = tuple(choice for literal in literals for choice in get_args(literal))
        return f"field {name!r} is {value!r}, not one of {choices}"
    extras = [extra for part in _parts(kind) for extra in getattr(part, "__metadata__", ())]
    for bounds in extras:
        if not isinstance(bounds, msgspec.Meta) or isinstance(value, bool):
            continue
        if bounds.description is not None and isinstance(value, int | float | list | tuple):
            return f"{name} must be {bounds.description}, not {value}"
        if bounds.pattern is not None and isinstance(value, str):
            return f"{name} must be {bounds.description}, not {value!r}"
        if not isinstance(value, int | float):
            continue
        if bounds.gt == 0 and not value > 0:
            return f"{name} must be positive, not {value}"
        if bounds.ge is not None and not value >= bounds.ge:
            return f"{name} must be at least {bounds.ge}, not {value}"
        if bounds.le is not None and not value <= bounds.le:
            return f"{name} must be at most {bounds.le}, not {value}"
    return f"field {name!r} is {value!r}: {error}"


def _is_plain(kind: Any) -> bool:
    """Whether values of a type can be checked: numbers, strings, choices and unions of them."""
    made_of = (Annotated, Literal, UnionType, Union)
    return all(part in _PLAIN or get_origin(part) in made_of for part in _parts(kind))


def _parts(kind: Any) -> Iterator[Any]:
    """Yields a type and those that it is made of, the outermost first."""
    yield kind
    if get_origin(kind) is not Literal:
        for part in get_args(kind)[: 1 if get_origin(kind) is Annotated else None]:
            yield from _parts(part)


def printable(text: str) -> str:
    r"""Escapes what is no visible character: text of files must not move a terminal's cursor.

    Example:
        >>> printable("a\x1b[2Jé\n")
        'a\\x1b[2Jé\\n'
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def nearest(name: str, names: Iterable[str]) -> str:
    """Suggests known names for an unknown one, as the end of an error message.

    Example:
        >>> nearest("paired-outter", ["outer", "paired-outer", "mlp"])
        'did you mean paired-outer or outer?'
        >>> nearest("x", map(str, range(300)))
        'choose from 0, 1, 2, 3, 4 and 295 others'
    """
    names = list(names)
    if matches := difflib.get_close_matches(name, names, n=3, cutoff=0.4):
        return f"did you mean {' or '.join(matches)}?"
    shown = len(names) if len(names) <= 30 else 5
    others = f" and {len(names) - shown} others" if shown < len(names) else ""
    return f"choose from {', '.join(names[:shown])}{others}"
