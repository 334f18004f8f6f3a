"""Whether one experiment is better than another: over its seeds, and over several tasks."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from math import ceil, nan
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm, permutation_test

from ...core.numbers import mean_std, number
from ...core.recipe import Recipe
from .experiments import TASK
from .interval import FEWEST, Interval
from .package_rows import read_rows
from .table import measure_of, read_evaluations, value_of

Task = tuple[Any, ...]
Values = Mapping[Any, Sequence[float]]
"""The values of runs by their task."""

HEADER = (
    *("recipe", "runs", "mean ± sample deviation", "difference from the first [95%]"),
    *("probability of improvement", "p of a permutation test", "runs for 80% power"),
)
"""The header of :func:`compare_with_first`."""
WORDS = (
    "The probability of improvement is that of one run being better than one of the first. The "
    "last column is how many runs of each find this difference at the 5% level four times in five. "
    f"Below {FEWEST} runs there is no interval."
)
"""What its columns mean."""
SUMMARY = (
    *("network", "tasks", "runs", "interquartile mean of normalized returns [95%]"),
    "probability of improvement over the first [95%]",
)
"""The header of :func:`summarize`."""
# Fields that change which returns a task allows.
_ALTER = ("env_settings", "wrappers", "hide_velocities")
_LEVEL, _POWER = 0.05, 0.8
_RESAMPLES = 2_000
_PERMUTATIONS = 10_000
_LEAST_RUNS = 4  # of 3 against 3, no permutation test is below 0.05


@dataclass(frozen=True)
class Comparison:
    """How the runs of one experiment differ from those of another."""

    difference: Interval
    """Of the means, with its bootstrap interval; without one for fewer than five runs."""
    improvement: float
    """The probability that a run of this one is better than a run of the other."""
    p: float
    """Of a two-sided permutation test of the difference; NaN for a single run."""
    runs: float
    """Runs of each that find such a difference at the 5% level four times in five; NaN if there is
    none, or for a single run."""


def compare(ours: Sequence[float], others: Sequence[float]) -> Comparison:
    """Compares the values of runs.

    The number of runs is that of a test of two normal distributions (Colas et al., "How Many Random
    Seeds?", arXiv 1806.08295), with the difference and the deviations measured here.

    Args:
        ours: the value of each run (seed).
        others: those of the experiment to compare with.

    Example:
        >>> found = compare([4.0, 5.0, 6.0, 7.0], [1.0, 2.0, 3.0, 4.0])
        >>> found.difference.middle, found.improvement, round(found.p, 3), found.runs
        (3.0, 0.96875, 0.057, 4)
    """
    a, b = np.asarray(ours, float), np.asarray(others, float)
    difference = float(a.mean() - b.mean())
    low = high = p = runs = nan
    if min(len(a), len(b)) >= FEWEST:
        draws = _resampled(a, 0).mean(1) - _resampled(b, 1).mean(1)
        low, high = np.quantile(draws, [0.025, 0.975])
    if min(len(a), len(b)) > 1:
        p = permutation_test(
            (a, b),
            lambda x, y, axis: x.mean(axis) - y.mean(axis),
            n_resamples=_PERMUTATIONS,
            vectorized=True,
            rng=0,
        ).pvalue
        if difference:
            z = norm.ppf(1 - _LEVEL / 2) + norm.ppf(_POWER)
            runs = max(ceil(z**2 * (a.var(ddof=1) + b.var(ddof=1)) / difference**2), _LEAST_RUNS)
    better = float(_better(a, b))
    return Comparison(Interval(difference, float(low), float(high)), better, float(p), runs)


def compare_with_first(named: Sequence[tuple[str, Sequence[float]]]) -> list[list[str]]:
    """Writes how experiments differ from the first, under :data:`HEADER`.

    Args:
        named: the name and the values of each.

    Returns:
        A row for each; none if there is only one.
    """
    if len(named) < 2:
        return []
    rows = [[name, str(len(values)), mean_std(values)] for name, values in named]
    for place, row in enumerate(rows):
        found = compare(named[place][1], named[0][1])
        texts = [str(found.difference), *map(number, (found.improvement, found.p, found.runs))]
        row += texts if place else [""] * len(texts)
    return rows


def interquartile_mean(values: Values) -> Interval:
    """The interquartile mean over all runs of all tasks, each task counting equally.

    Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice", arXiv
    2108.13264: the interval is a bootstrap of the runs within each task. Where a task has a single
    run, or all tasks fewer than five, there is none.

    Args:
        values: normalized returns.

    Example:
        >>> interquartile_mean({("a",): [0.0, 0.4], ("b",): [0.6, 9.0]}).middle
        0.5
    """
    groups = [np.asarray(found, float) for found in values.values()]
    weights = np.concatenate([np.full(len(x), 1 / len(x) / len(groups)) for x in groups])

    def middle(draws: Sequence[np.ndarray]) -> np.ndarray:
        drawn = np.concatenate(draws, -1)
        order = drawn.argsort(-1)
        ends = weights[order].cumsum(-1)
        starts = ends - weights[order]
        inside = ends.clip(0.25, 0.75) - starts.clip(0.25, 0.75)
        return (np.take_along_axis(drawn, order, -1) * inside).sum(-1) / 0.5

    found = middle([_resampled(x, task) for task, x in enumerate(groups)])
    return _with_interval(middle(groups), found, groups)


def probability_of_improvement(ours: Values, others: Values) -> Interval:
    """The probability that a run is better than one of others, the mean over tasks.

    Ties count half. The interval is a bootstrap of the runs within each task (arXiv 2108.13264);
    there is none where a task has a single run, or one of both fewer than five in all.

    Args:
        ours: values by task.
        others: those to compare with, of the same tasks.

    Example:
        >>> probability_of_improvement({"a": [2.0, 3.0]}, {"a": [1.0, 3.0]}).middle
        0.625
    """
    pairs = [(np.asarray(ours[task], float), np.asarray(others[task], float)) for task in ours]
    draws = [
        _better(_resampled(x, 2 * i), _resampled(y, 2 * i + 1)) for i, (x, y) in enumerate(pairs)
    ]
    better = np.mean([_better(x, y) for x, y in pairs])
    return _with_interval(better, np.mean(draws, 0), *zip(*pairs, strict=True))


def _with_interval(
    value: np.ndarray, draws: np.ndarray, *networks: Sequence[np.ndarray]
) -> Interval:
    """A number with the interval of its resamples, or with none if a network has too few runs."""
    counts = [[*map(len, groups)] for groups in networks]
    enough = min(map(min, counts)) > 1 and min(map(sum, counts)) >= FEWEST
    low, high = np.quantile(draws, [0.025, 0.975]) if enough else (nan, nan)
    return Interval(float(value), float(low), float(high))


def _better(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The share of pairs in which the first is better, [..., runs] and [..., others] -> [...]."""
    x, y = x[..., :, None], y[..., None, :]
    return ((x > y) + 0.5 * (x == y)).mean((-2, -1))


def _resampled(values: np.ndarray, seed: int) -> np.ndarray:
    """Draws runs with replacement, [resamples, runs]."""
    return np.random.default_rng(seed).choice(values, (_RESAMPLES, len(values)))


def read_references(path: Path | None = None) -> dict[str, tuple[float, float]]:
    """Reads the returns of a random policy and of the best published PPO, by the task's name.

    Ours are those of random actions over 100 episodes, and of RL Zoo's tuned agents or the PPO of
    TD3's authors (arXiv 1802.09477, table 1), on the version of the task that they had.

    Args:
        path: a CSV file with the columns env, random and best; by default ours.

    Raises:
        ValueError: if the file is not of this form.
    """
    try:
        rows: Iterable[Mapping[str, str]] = read_rows("reference_returns.csv")
        if path is not None:
            rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
        references = {row["env"]: (float(row["random"]), float(row["best"])) for row in rows}
        for env, (random, best) in references.items():
            if not -math.inf < random < best < math.inf:
                raise ValueError(f"best must be above random and finite, but is not for {env}")
        return references
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path} must be a CSV file with the columns env, random and best, and numbers in the "
            f"last two: {error}"
        ) from error


def normalize(
    values: Sequence[float], env: str, references: Mapping[str, tuple[float, float]]
) -> list[float]:
    """Returns as shares of the way from a random policy to the best published one.

    Raises:
        ValueError: if there are no reference returns for the task.
    """
    if env not in references:
        raise ValueError(
            f"no reference returns for {env}: give a CSV file with the columns env, random and "
            "best, or leave its runs out"
        )
    random, best = references[env]
    return [(value - random) / (best - random) for value in values]


def read_networks(
    folders: Iterable[Path],
    patterns: Sequence[str] = (),
    references: Path | None = None,
) -> tuple[dict[str, dict[Task, list[float]]], list[str]]:
    """Reads the normalized returns of networks on several tasks.

    Args:
        folders: as for ``table``.
        patterns: which runs belong together, of the last part of their recipes' names, such as
            "enhanced-tit*"; by default those with the same last part.
        references: a file for :func:`read_references`.

    Returns:
        By network, and then by task, the value of each run, and notes about runs and tasks that are
        left out, changed settings, altered tasks, and lengths and algorithms that differ. All
        networks have the same tasks.

    Raises:
        ValueError: if a pattern has no run, a network has two settings on a task, or no task is
            common to all.
    """
    experiments, notes = read_evaluations(folders)
    returns = read_references(references)
    networks: dict[str, dict[Task, list[float]]] = {pattern: {} for pattern in patterns}
    lengths: dict[Task, set[int]] = {}
    algorithms: dict[Task, str] = {}
    for experiment, evaluations in experiments:
        settings = experiment.settings
        last = experiment.name.rpartition("/")[2]
        name = next((x for x in patterns if fnmatchcase(last, x)), "") if patterns else last
        if not name:
            continue
        found = networks.setdefault(name, {})
        task = task_of(settings)
        if task in found:
            raise ValueError(
                f"{name} has two settings on {settings.env}, also {experiment.label}: name folders "
                "or patterns that hold one of them"
            )
        lengths.setdefault(task, set()).add(settings.final_step)
        algorithms[task] = settings.algorithm
        if experiment.changes:
            notes.append(f"{name} has changed settings on {settings.env}: {experiment.changes}")
        if altered := [key for key in _ALTER if getattr(settings, key, None)]:
            notes.append(
                f"{settings.env} of {name} is normalized as the task without its "
                f"{' and '.join(altered)}"
            )
        values = [value_of(evaluation) for evaluation in evaluations]
        scored = measure_of(settings, evaluations[0]) != "return"
        found[task] = (
            [x / 100 for x in values] if scored else normalize(values, settings.env, returns)
        )
    if not networks:
        raise ValueError("; ".join(["no evaluated run", *notes]))
    if missing := [name for name, found in networks.items() if not found]:
        raise ValueError(f"no evaluated run of {missing[0]}")
    common = set.intersection(*({*found} for found in networks.values()))
    if not common:
        raise ValueError(f"no task has runs of all of {', '.join(networks)}")
    notes += [
        f"{task[0]} is left out of {name}: not all networks have runs of it"
        for name, found in networks.items()
        for task in found
        if task not in common
    ]
    notes += [
        f"runs of {task[0]} have different lengths: {', '.join(map(str, sorted(found)))} steps"
        for task, found in lengths.items()
        if task in common and len(found) > 1
    ]
    if len(together := {algorithms[task] for task in common}) > 1:
        notes.append(f"several algorithms count together: {', '.join(sorted(together))}")
    return {
        name: {task: values for task, values in found.items() if task in common}
        for name, found in networks.items()
    }, notes


def task_of(settings: Recipe) -> Task:
    """The fields that determine what is learned."""
    return tuple(getattr(settings, name, None) for name in (*TASK, "dataset"))


def summarize(networks: Mapping[str, Values]) -> list[list[str]]:
    """Writes a summary over tasks, a row for each network, under :data:`SUMMARY`.

    Args:
        networks: as :func:`read_networks` returns them; the others are compared with the first.
    """
    first = next(iter(networks.values()))
    return [
        [
            name,
            str(len(values)),
            str(sum(map(len, values.values()))),
            str(interquartile_mean(values)),
            str(probability_of_improvement(values, first)) if values is not first else "",
        ]
        for name, values in networks.items()
    ]
