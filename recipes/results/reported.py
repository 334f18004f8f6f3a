"""What others report for the same task, network and data: the paper and published results."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from ..dataset_recipe import DatasetRecipe
from ..recipe import Recipe
from ..registry import RECIPES

_TASK = (
    *("env", "env_settings", "wrappers", "observation_keys", "hide_velocities", "mask_actions"),
    "backbone",
)
"""The fields that determine which task is learned, and by which network."""


@dataclass(frozen=True)
class Result:
    """The result of an experiment in the paper's tables."""

    table: str
    mean: float
    std: float


@dataclass(frozen=True)
class Published:
    """The result of another implementation with the same kind of network."""

    source: str
    """Who reports it."""
    url: str
    """Where."""
    mean: float
    std: float
    note: str
    """How it was measured: version of the task, steps, seeds."""


@cache
def paper_results() -> dict[str, Result]:
    """What the paper reports, by the recipe's name.

    arXiv 2212.14538, tables of section 4 and the ablation; the standard deviations of Decision
    Transformer are taken from the curves that its authors published, since the paper applied the
    score's offset to them.

    Example:
        >>> paper_results()["ppo/mountaincar/enhanced-tit"].mean
        -97.0
    """
    return {
        row["recipe"]: Result(row["table"], float(row["mean"]), float(row["std"]))
        for row in _rows("paper_results.csv")
    }


@cache
def published_results() -> dict[str, tuple[Published, ...]]:
    """What others have published, by the name of the recipe with the same task and network.

    Example:
        >>> [result.source for result in published_results()["ppo/acrobot/mlp"]]
        ['CleanRL', 'RL Zoo']
    """
    results: dict[str, tuple[Published, ...]] = {}
    for row in _rows("published_results.csv"):
        name = row["recipe"]
        mean, std = float(row["mean"]), float(row["std"])
        result = Published(row["source"], row["url"], mean, std, row["note"])
        results[name] = (*results.get(name, ()), result)
    return results


def reported_of(recipe: Recipe) -> tuple[Result | None, tuple[Published, ...]]:
    """What the paper and others report, if task, network and data are those of the recipe's name.

    Args:
        recipe: the settings of a run.
    """
    plain = plain_name(recipe.name)
    named = RECIPES.get(recipe.name) or RECIPES.get(plain)
    if named is None or any(_part(recipe, field) != _part(named, field) for field in _TASK):
        return None, ()
    if isinstance(recipe, DatasetRecipe) and _stem(recipe.dataset) not in plain.split("/"):
        return None, ()
    return paper_results().get(plain), published_results().get(plain, ())


def plain_name(name: str) -> str:
    """The name without the suffix that marks other settings: "-tuned", "-protocol"."""
    if name in paper_results():
        return name
    return name.removesuffix("-tuned").removesuffix("-protocol")


def _rows(file: str) -> Iterator[dict[str, str]]:
    text = resources.files(__package__).joinpath(file).read_text(encoding="utf-8")
    yield from csv.DictReader(io.StringIO(text))


def _part(recipe: Recipe, field: str) -> Any:
    """A field that only some recipes have; None in the others."""
    return getattr(recipe, field, None)


def _stem(dataset: str) -> str:
    """A data set's name, also if it is given as D4RL's file: "hopper_medium-v2.hdf5"."""
    return Path(dataset).name.removesuffix(".hdf5").replace("_", "-")
