"""Numbers for people: three significant digits, and the same decimals side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import floor, isfinite, log10
from statistics import fmean, stdev
from typing import Any

_DIGITS = 3
_MOST_DECIMALS = 6  # smaller numbers are written with a power of ten


def numbers(values: Sequence[float]) -> list[str]:
    """Formats numbers that stand together: the largest has three significant digits or is whole.

    Zeros that all would end with are left out. From 10,000 on, thousands are separated. A number
    that is not finite is "-".

    Example:
        >>> numbers([1.0, 0.61, 0.394]), numbers([0.39, 5.6e-17]), numbers([-81.432, 7.0])
        (['1.00', '0.61', '0.39'], ['0.39', '0.00'], ['-81.4', '7.0'])
    """
    largest = max((abs(value) for value in values if isfinite(value)), default=0.0)
    if not largest:
        decimals = 0
    else:  # of 99.96, which rounds to 100, there are none
        decimals = max(0, _DIGITS - 1 - floor(log10(float(f"{largest:.{_DIGITS - 1}e}"))))
    if decimals > _MOST_DECIMALS:
        return [f"{value:.{_DIGITS}g}" if isfinite(value) else "-" for value in values]
    texts = [f"{value:.{decimals}f}" for value in values if isfinite(value)]
    while decimals and all(text.endswith("0") for text in texts):
        texts = [text[:-1] for text in texts]
        decimals -= 1
    return [_text(value, decimals) for value in values]


def _text(value: float, decimals: int) -> str:
    if not isfinite(value):
        return "-"
    text = f"{value:{',' if abs(value) >= 10_000 else ''}.{decimals}f}"
    return text.lstrip("-") if not float(text.replace(",", "")) else text


def number(value: float) -> str:
    """Formats one number.

    Example:
        >>> number(-81.432), number(9358.4), number(0.0123), number(500), number(1e-9)
        ('-81.4', '9358', '0.0123', '500', '1e-09')
    """
    return numbers([value])[0]


def plus_minus(mean: float, spread: float) -> str:
    """Writes a mean and its spread.

    Example:
        >>> plus_minus(0.9724, 0.0119), plus_minus(7.32, 16.8), plus_minus(500, 0)
        ('0.972 ± 0.012', '7.3 ± 16.8', '500 ± 0')
    """
    return " ± ".join(numbers([mean, spread]))


def mean_std(values: Sequence[float]) -> str:
    """Writes a mean and the sample standard deviation; of one value, the value.

    Example:
        >>> mean_std([1.0, 0.61, 0.39]), mean_std([500.0] * 5), mean_std([2.5])
        ('0.667 ± 0.309', '500 ± 0', '2.5')
    """
    if len(values) == 1:
        return number(values[0])
    return plus_minus(fmean(values), stdev(values))


def measured_words(evaluation: Mapping[str, Any]) -> str:
    """Says what an evaluation measured on held-out episodes.

    Example:
        >>> measured_words({"held_out": {"action_error": 0.02262, "nll": 1.3}})
        'action_error 0.02262, nll 1.3'
    """
    return ", ".join(f"{name} {value:.4g}" for name, value in evaluation["held_out"].items())
