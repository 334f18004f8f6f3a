"""The contents of a report's tables and sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...recipe import Recipe, experiment_of
from ...registry import RECIPES
from ..cell import Cell
from ..experiments import fields_of
from ..metric_words import MetricWords, limit, words_of
from .charts import last_value
from .run_data import Group, RunData

_OFTEN = 0.25  # minimum share of batches outside a limit for a metric to be pointed out


@dataclass(frozen=True)
class Difference:
    """A field in which settings differ."""

    field: str
    values: tuple[str, ...]
    """The values in each of the compared settings."""


@dataclass(frozen=True)
class Finding:
    """A metric that was often outside its healthy range."""

    words: MetricWords
    text: str
    """The limit, and in how many batches of which experiment it was exceeded."""


def settings_of(recipe: Recipe) -> dict[str, str]:
    """Returns all settings, with nested ones by their full names, such as "backbone.num_frames"."""
    return {name: _text(value) for name, value in fields_of(recipe).items()}


def differences(recipes: Sequence[Recipe]) -> list[Difference]:
    """Lists the fields in which the settings of experiments differ, ignoring seed and machine.

    Fields that some lack, such as those of an encoder that others replace, are left out.
    """
    settings = [settings_of(experiment_of(recipe)) for recipe in recipes]
    shared = [name for name in settings[0] if all(name in one for one in settings)]
    rows = [Difference(name, tuple(one[name] for one in settings)) for name in shared]
    return [row for row in rows if row.field != "name" and len(set(row.values)) > 1]


def changes(named: Recipe, recipe: Recipe) -> list[Difference]:
    """Lists the fields in which settings differ from the recipe of the same name."""
    before, now = settings_of(experiment_of(named)), settings_of(experiment_of(recipe))
    return [
        Difference(name, (before.get(name, "-"), value))
        for name, value in now.items()
        if before.get(name) != value
    ]


def named_recipe(recipe: Recipe) -> Recipe | None:
    """Returns the recipe of that name that comes with this version, if there is one."""
    return dict(RECIPES).get(recipe.name)


def findings(groups: Sequence[Group]) -> list[Finding]:
    """Lists metrics that were outside their healthy range in a quarter of the batches or more."""
    found: dict[tuple[str, str], tuple[MetricWords, list[str]]] = {}
    for group in groups:
        whose = f"{group.label} " if len(groups) > 1 else ""
        for column in group.columns:
            words = words_of(group.recipe.algorithm, column)
            for formula, sign, side in ((words.low, -1, "below"), (words.high, 1, "above")):
                if (bound := limit(formula, group.recipe)) is None:
                    continue
                shares = [_share_outside(run, words, bound, sign) for run in group.runs]
                known = [share for share in shares if share is not None]
                if known and np.mean(known) >= _OFTEN:
                    beyond = f"{side} {number(bound)}"
                    _, texts = found.setdefault((column, beyond), (words, []))
                    texts.append(f"{whose}in {np.mean(known):.0%} of the batches")
    return [
        Finding(words, f"{beyond}: {', '.join(texts)}")
        for (_, beyond), (words, texts) in found.items()
    ]


def checked_metrics(groups: Sequence[Group]) -> list[str]:
    """Names the metrics that :func:`findings` looks at."""
    names: dict[str, None] = {}
    for group in groups:
        for column in group.columns:
            words = words_of(group.recipe.algorithm, column)
            if words.low or words.high:
                names[column] = None
    return list(names)


def headline(group: Group, cell: Cell | None) -> tuple[str, str, str]:
    """Returns an experiment's result: a number, its interval, and a sentence about both."""
    steps = f"{max(run.steps for run in group.runs):,} {unit_of(group.recipe)}"
    if cell is None:
        values = [last_value(run, "return_mean") for run in group.runs]
        known = [value for value in values if np.isfinite(value)]
        reached = number(float(f"{np.mean(known):.3g}")) if known else "not known"
        return "not evaluated", "", f"Returns of training at the end: {reached}, after {steps}."
    if cell.runs == 1:
        counts = [run.evaluation["episodes"] for run in group.runs if run.evaluation]
        count = f" over {counts[0]} episodes"
        return (
            number(cell.iqm),
            f"± {spread(cell.std_episodes)}",
            f"Mean and standard deviation{count} after {steps}; one run.",
        )
    return (
        number(cell.iqm),
        f"[{number(cell.low)}, {number(cell.high)}]",
        f"Interquartile mean and its 95% interval over {cell.runs} runs after {steps}.",
    )


def unit_of(recipe: Recipe) -> str:
    """The unit of a recipe's steps."""
    return "gradient steps" if recipe.offline else "environment steps"


def number(value: float) -> str:
    """Formats a number for people: "500", "-81.4", "0.0123"."""
    if value != value:
        return "-"
    if value == int(value) and abs(value) < 1e15:
        return f"{value:,.0f}"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def spread(value: float) -> str:
    """Formats a standard deviation, of which only two digits matter."""
    return number(value) if value != value or abs(value) >= 10 else number(float(f"{value:.2g}"))


def duration(seconds: float) -> str:
    """Formats a duration: "7 min 12 s", "3 h 5 min"."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours} h {minutes} min"
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"


def _share_outside(run: RunData, words: MetricWords, bound: float, sign: int) -> float | None:
    """The share of rows in which a metric is beyond a limit; None if it was not measured."""
    values = run.metrics.get(words.column)
    if values is None:
        return None
    counts = np.isfinite(values)
    if words.needs in run.metrics:
        counts &= np.diff(run.metrics[words.needs], prepend=np.nan) != 0
    outside = sign * (values[counts] - bound) > 0
    return float(outside.sum() / len(values)) if counts.any() else None


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    if value is None:
        return "none"
    if isinstance(value, list):
        return ", ".join(map(_text, value)) or "none"
    if isinstance(value, dict):
        return "none"
    return f"{value:,}" if isinstance(value, int) and abs(value) >= 10_000 else str(value)
