"""Interquartile means over runs and over tasks, and their intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import bootstrap, trim_mean

from ...core.numbers import number, numbers

FEWEST = 5
"""Of fewer runs, the quarters at both ends are no runs, and intervals say nothing."""


@dataclass(frozen=True)
class Interval:
    """A number over runs, and its 95% interval, which is NaN for too few runs."""

    middle: float
    low: float
    high: float

    def __str__(self) -> str:
        """As "0.31 [0.28, 0.35]"."""
        if np.isnan(self.low):
            return number(self.middle)
        return "{} [{}, {}]".format(*numbers([self.middle, self.low, self.high]))


def interval_of(values: Sequence[float] | np.ndarray) -> Interval:
    """Summarizes one number per run, as in the tables of results.

    Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice", arXiv
    2108.13264.

    Args:
        values: one value of each run (seed).

    Returns:
        The interquartile mean and its interval by bootstrap over runs; of fewer than five runs,
        their mean without an interval.

    Example:
        >>> interval_of([1.0, 2.0, 3.0, 4.0, 100.0]).middle, str(interval_of([1.0, 5.0]))
        (3.0, '3')
    """
    x = np.array(values, dtype=float)
    if len(x) < FEWEST:
        return Interval(float(x.mean()), np.nan, np.nan)
    found = bootstrap((x,), _iqm, n_resamples=10_000, method="percentile", rng=0)
    return Interval(float(_iqm(x)), *map(float, found.confidence_interval))


def intervals_of(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Summarizes curves, as :func:`interval_of` does, at every point.

    Args:
        values: float [runs, points].

    Returns:
        Interquartile means and both ends of their 95% intervals, float [points] each. Of fewer than
        five runs, means, and the ends are NaN.

    Example:
        >>> intervals_of(np.array([[1.0, 5.0], [3.0, 5.0]]))[0].tolist()
        [2.0, 5.0]
    """
    if len(values) < FEWEST:
        unknown = np.full(values.shape[1], np.nan)
        return values.mean(0), unknown, unknown
    found = bootstrap(
        (values,), _iqm, axis=0, n_resamples=2_000, batch=200, method="percentile", rng=0
    )
    return _iqm(values, axis=0), *found.confidence_interval


def _iqm(x: np.ndarray, axis: int = -1) -> np.ndarray:
    return trim_mean(x, 0.25, axis=axis)
