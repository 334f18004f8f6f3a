"""Descriptions of the metrics: the single source of reports and of docs/reference/metrics.md."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache

from ...core.recipe import Recipe, get_recipe_class
from .package_rows import read_rows

_TARGET = re.compile(r"return_-?[\d.]+(e[+-]?\d+)?")
_TIMES = " * "


@dataclass(frozen=True)
class MetricWords:
    """What a column of ``metrics.csv`` is, and how to read it, in sentences.

    Code is between backticks.
    """

    column: str
    what: str
    healthy: str = ""
    otherwise: str = ""
    low: str = ""
    """What it should not fall below: a number, as a formula of :func:`limit`."""
    high: str = ""
    """What it should not rise above."""
    needs: str = ""
    """A column that must vary for this one to be meaningful."""


def words_of(algorithm: str, column: str) -> MetricWords:
    """Looks up the description of a column of an algorithm's metrics.

    Args:
        algorithm: the name of the algorithm.
        column: the column; an unknown one is described by its name alone.

    Example:
        >>> words_of("ppo", "clip_fraction").what
        'The share of the samples whose probability ratio was clipped.'
        >>> words_of("dt", "return_3600").what
        'The mean return of the evaluation that aims for 3600.'
    """
    found = _read()
    known = next((found[of, column] for of in family(algorithm) if (of, column) in found), None)
    if known is None and _TARGET.fullmatch(column):
        target = column.removeprefix("return_")
        what = f"The mean return of the evaluation that aims for {target}."
        return MetricWords(column, what)
    return known or MetricWords(column, "")


def known_columns(algorithm: str) -> list[str]:
    """Lists the described columns of an algorithm, the most informative first."""
    kinds = family(algorithm)
    return [column for of, column in _read() if of in kinds]


def family(algorithm: str) -> list[str]:
    """An algorithm, those whose recipes its own is a subclass of, and all of them, ""."""
    kinds = get_recipe_class(algorithm).__mro__
    return [*(vars(kind)["algorithm"] for kind in kinds if "algorithm" in vars(kind)), ""]


def limit(formula: str, recipe: Recipe) -> float | None:
    """Reads a limit: a number, or a number times a field of the recipe.

    Args:
        formula: such as "0.02" or "10 * max_grad_norm".
        recipe: the settings of the run.

    Returns:
        The limit; None if there is none here.

    Example:
        >>> from recipes.core.registry import get_recipe
        >>> limit("10 * max_grad_norm", get_recipe("ppo/cartpole/mlp"))
        5.0
    """
    if not formula:
        return None
    factor, _, name = formula.partition(_TIMES)
    if not name:
        return float(factor)
    value = getattr(recipe, name, None)
    return None if value is None else float(factor) * float(value)


@cache
def _read() -> dict[tuple[str, str], MetricWords]:
    """All descriptions, by algorithm (empty for all of them) and column."""
    found = {}
    for row in read_rows("metrics.csv"):
        for algorithm in row.pop("algorithms").split() or [""]:
            found[algorithm, row["column"]] = MetricWords(**row)
    return found
