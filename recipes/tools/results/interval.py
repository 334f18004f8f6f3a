"""Interquartile means over runs, and their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import bootstrap, trim_mean


@dataclass(frozen=True)
class Interval:
    """An interquartile mean over runs, and its 95% interval, which is NaN for a single run."""

    iqm: float
    low: float
    high: float

    def __str__(self) -> str:
        """As "0.310 [0.280, 0.350]"."""
        return f"{self:.3f}"

    def __format__(self, spec: str) -> str:
        """Each number in a format, such as ".0f"."""
        numbers = [format(value, spec or ".3f") for value in (self.iqm, self.low, self.high)]
        return numbers[0] if np.isnan(self.low) else "{} [{}, {}]".format(*numbers)


def interval_of(values: Sequence[float] | np.ndarray) -> Interval:
    """Summarises one number per run, as in the tables of results.

    Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice", arXiv
    2108.13264.

    Args:
        values: one value of each run (seed).

    Example:
        >>> interval_of([1.0, 2.0, 3.0, 10.0]).iqm
        2.5
    """
    x = np.array(values, dtype=float)
    low = high = float("nan")
    if len(x) > 1:
        found = bootstrap((x,), _iqm, n_resamples=10_000, method="percentile", rng=0)
        low, high = map(float, found.confidence_interval)
    return Interval(float(_iqm(x)), low, high)


def intervals_of(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Summarises curves, as :func:`interval_of` does, at every point.

    Args:
        values: float [runs, points].

    Returns:
        Interquartile means and both ends of their 95% intervals, float [points] each. For a single
        run, the ends are NaN.

    Example:
        >>> intervals_of(np.array([[1.0, 5.0], [3.0, 5.0]]))[0].tolist()
        [2.0, 5.0]
    """
    means = _iqm(values, axis=0)
    if len(values) == 1:
        unknown = np.full(len(means), np.nan)
        return means, unknown, unknown
    found = bootstrap(
        (values,), _iqm, axis=0, n_resamples=2_000, batch=200, method="percentile", rng=0
    )
    return means, *found.confidence_interval


def _iqm(x: np.ndarray, axis: int = -1) -> np.ndarray:
    return trim_mean(x, 0.25, axis=axis)
