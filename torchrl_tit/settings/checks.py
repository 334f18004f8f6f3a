"""Checks shared by several settings: each raises ValueError naming the field and its value."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def check_at_least(settings: object, **minima: float) -> None:
    """Raises ValueError if a field is below its minimum or not a number.

    Example:
        >>> from types import SimpleNamespace
        >>> check_at_least(SimpleNamespace(num_frames=0), num_frames=1)
        Traceback (most recent call last):
            ...
        ValueError: num_frames must be at least 1, not 0
    """
    for field, minimum in minima.items():
        value = getattr(settings, field)
        if not value >= minimum:
            raise ValueError(f"{field} must be at least {minimum}, not {value}")


def check_at_most(settings: object, **maxima: float) -> None:
    """Raises ValueError if a field is above its maximum or not a number."""
    for field, maximum in maxima.items():
        value = getattr(settings, field)
        if not value <= maximum:
            raise ValueError(f"{field} must be at most {maximum}, not {value}")


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
