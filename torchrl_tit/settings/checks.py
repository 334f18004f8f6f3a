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


def check_positive(settings: object, *fields: str) -> None:
    """Raises ValueError if a field is not above 0."""
    for field in fields:
        if not getattr(settings, field) > 0:
            raise ValueError(f"{field} must be positive, not {getattr(settings, field)}")


def check_probability(settings: object, *fields: str) -> None:
    """Raises ValueError if a field is not in [0, 1)."""
    for field in fields:
        if not 0 <= getattr(settings, field) < 1:
            raise ValueError(f"{field} is a probability in [0, 1), not {getattr(settings, field)}")


def check_choice(settings: object, field: str, choices: Iterable[object]) -> None:
    """Raises ValueError if a field is not one of the choices."""
    if getattr(settings, field) not in choices:
        raise ValueError(
            f"unknown {field} {getattr(settings, field)!r}: choose one of {tuple(choices)}"
        )


def check_widths(settings: object, field: str) -> None:
    """Raises ValueError if a field is not the widths of at least one layer."""
    widths = getattr(settings, field)
    if not widths or min(widths) < 1:
        raise ValueError(f"{field} must be at least one width of at least 1, not {widths}")


def nearest(name: str, names: Iterable[str]) -> str:
    """Suggests known names for an unknown one, as the end of an error message.

    Example:
        >>> nearest("paired-outter", ["outer", "paired-outer", "mlp"])
        'did you mean paired-outer or outer?'
    """
    names = list(names)
    matches = difflib.get_close_matches(name, names, n=3, cutoff=0.4)
    return f"did you mean {' or '.join(matches)}?" if matches else f"choose from {', '.join(names)}"
