"""Arguments of public calls are checked as fields of settings are: by their annotations."""

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
    """Makes a call fail at once, in one line, where an argument cannot mean anything.

    Arguments are checked whose annotation is a number, a text, a choice (``Literal``) or several of
    these; with the bounds that stand in it (:mod:`torchrl_tit.settings.numbers`). Others are left
    to the function.

    Args:
        function: what to check the arguments of; of a class, ``__init__``.

    Raises:
        ValueError: when it is called, if an argument is of another type, not finite or out of
            bounds.

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
            return function(*args, **kwargs)  # which says it better
        for name, kind in kinds().items():
            if name in given:
                value: Any = given[name]
                # NumPy's numbers are as good as Python's.
                checked(name, value.item() if hasattr(value, "item") else value, kind)
        return function(*args, **kwargs)

    return call


def _is_plain(kind: Any) -> bool:
    """Whether values of a type can be checked: numbers, texts, choices and unions of them."""
    if get_origin(kind) is Literal:
        return True
    if get_origin(kind) is Annotated:
        return _is_plain(get_args(kind)[0])
    if get_origin(kind) in (UnionType, Union):
        return all(map(_is_plain, get_args(kind)))
    return kind in _PLAIN
