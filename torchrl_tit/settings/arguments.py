"""Checks arguments of public calls by their annotations, like the fields of settings."""

from __future__ import annotations

import inspect
from collections.abc import Callable
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

from torchrl_tit.settings.fields import checked

P = ParamSpec("P")
R = TypeVar("R")
_PLAIN = (bool, float, int, str, NoneType)


def checked_arguments(function: Callable[P, R]) -> Callable[P, R]:
    """Makes a function check its arguments first, with an error message of one line.

    Arguments annotated as numbers, strings, choices (``Literal``) or unions of these are checked,
    including the bounds in the annotation (:mod:`torchrl_tit.settings.numbers`). Others are left to
    the function.

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


def _is_plain(kind: Any) -> bool:
    """Whether values of a type can be checked: numbers, strings, choices and unions of them."""
    if get_origin(kind) is Literal:
        return True
    if get_origin(kind) is Annotated:
        return _is_plain(get_args(kind)[0])
    if get_origin(kind) in (UnionType, Union):
        return all(map(_is_plain, get_args(kind)))
    return kind in _PLAIN
