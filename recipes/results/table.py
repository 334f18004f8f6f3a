"""From run folders to the paper's tables."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_tit.datasets import has_reference

from ..dataset_recipe import DatasetRecipe
from ..recipe import Recipe
from ..registry import RECIPES
from ..run import Run
from .cell import Cell
from .experiments import Experiment, group_runs
from .interval import interval_of

OTHER = "not in the paper"

_TASK = (
    *("env", "env_settings", "wrappers", "observation_keys", "hide_velocities", "mask_actions"),
    "backbone",
)
"""The fields that say which task is learned, and by which network."""


@dataclass(frozen=True)
class Result:
    """The result of an experiment in the paper's tables."""

    table: str
    mean: float
    std: float


def make_table(folders: Iterable[Path]) -> tuple[list[Cell], list[str]]:
    """Reads run folders and puts the runs of the same settings together, whatever their seed.

    Args:
        folders: run folders, or folders with run folders somewhere below.

    Returns:
        The cells, in the paper's order, and a note for each run that is left out, or was
        evaluated over another number of episodes than its recipe says.

    Raises:
        ValueError: if there is no evaluated run, or two of the same settings have the same seed.
    """
    evaluations: dict[Path, dict] = {}
    runs, notes = [], []
    for run in _runs(folders):
        try:
            text = (run.folder / "evaluation.json").read_text(encoding="utf-8")
            evaluation = json.loads(text)
            _value(evaluation), evaluation["returns"], evaluation["steps"]
        except (OSError, ValueError, LookupError, TypeError):
            notes.append(f"{run.folder} is left out: it has no evaluation yet")
            continue
        if evaluation["steps"] < run.recipe.final_step:
            notes.append(
                f"{run.folder} is left out: evaluated after {evaluation['steps']} of "
                f"{run.recipe.final_step} steps"
            )
            continue
        asked = run.recipe.evaluation_episodes
        if (episodes := evaluation.get("episodes", asked)) != asked:  # `evaluate --episodes`
            notes.append(f"{run.folder} was evaluated over {episodes} episodes, not {asked}")
        evaluations[run.folder] = evaluation
        runs.append(run)
    if not runs:
        raise ValueError(
            f"no evaluated run in {', '.join(map(str, folders))}" + "".join(f"; {n}" for n in notes)
        )
    cells = [
        _cell(experiment, [evaluations[run.folder] for run in experiment.runs])
        for experiment in group_runs(runs)
    ]
    order = {name: index for index, name in enumerate(paper_results())}

    def rank(cell: Cell) -> tuple[bool, int, str]:
        place = order.get(_plain(cell.recipe), len(order))
        return cell.table == OTHER, place, cell.label

    cells.sort(key=rank)
    return cells, notes


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
    text = resources.files(__package__).joinpath("paper_results.csv").read_text(encoding="utf-8")
    return {
        row["recipe"]: Result(row["table"], float(row["mean"]), float(row["std"]))
        for row in csv.DictReader(io.StringIO(text))
    }


def to_markdown(cells: Sequence[Cell]) -> str:
    """Writes cells as Markdown, one table for each of the paper's."""
    parts = []
    for table in dict.fromkeys(cell.table for cell in cells):
        lines = [
            f"### {table[0].upper()}{table[1:]}\n",
            "| recipe | runs | mean ± over runs | ± over episodes | interquartile mean [95%] "
            "| paper |",
            "|---|---|---|---|---|---|",
        ]
        lines += [_row(cell) for cell in cells if cell.table == table]
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def to_csv(cells: Sequence[Cell]) -> str:
    """Writes cells as CSV, one row each; unknown values are empty."""
    buffer = io.StringIO()
    names = [field.name for field in fields(Cell)]
    writer = csv.DictWriter(buffer, names, lineterminator="\n")
    writer.writeheader()
    for cell in cells:
        writer.writerow({k: "" if v != v else v for k, v in asdict(cell).items()})
    return buffer.getvalue()


def _runs(folders: Iterable[Path]) -> list[Run]:
    found: dict[Path, Run] = {}
    for folder in folders:
        paths = sorted(folder.rglob("recipe.json"))
        if not paths:
            raise ValueError(f"{folder} holds no run folder: there is no recipe.json in it")
        found |= {path.parent.resolve(): Run.open(path.parent) for path in paths}
    return list(found.values())


def _value(evaluation: dict) -> float:
    return float(evaluation["score"]["best"] if "score" in evaluation else evaluation["mean"])


def _measure(recipe: Recipe, evaluation: dict) -> str:
    return "normalized score" if "score" in evaluation and has_reference(recipe.env) else "return"


def _cell(experiment: Experiment, evaluations: Sequence[dict]) -> Cell:
    values = np.array([_value(evaluation) for evaluation in evaluations])
    spreads = [evaluation.get("score_std", evaluation["std"]) for evaluation in evaluations]
    interval = interval_of(values)
    paper = _paper_result(experiment.settings)
    return Cell(
        table=paper.table if paper else OTHER,
        recipe=experiment.name,
        runs=len(values),
        steps=min(evaluation["steps"] for evaluation in evaluations),
        mean=float(values.mean()),
        std=float(values.std()),
        std_episodes=float(np.mean(spreads)),
        iqm=interval.iqm,
        low=interval.low,
        high=interval.high,
        paper_mean=paper.mean if paper else float("nan"),
        paper_std=paper.std if paper else float("nan"),
        changes=experiment.changes,
        measure=_measure(experiment.settings, evaluations[0]),
    )


def _paper_result(recipe: Recipe) -> Result | None:
    """What the paper reports of a recipe, if task, network and data are those of its name."""
    plain = _plain(recipe.name)
    named = RECIPES.get(recipe.name) or RECIPES.get(plain)
    if named is None or any(_part(recipe, field) != _part(named, field) for field in _TASK):
        return None
    if isinstance(recipe, DatasetRecipe) and _stem(recipe.dataset) not in plain.split("/"):
        return None
    return paper_results().get(plain)


def _part(recipe: Recipe, field: str) -> Any:
    """A field that only some recipes have; None in the others."""
    return getattr(recipe, field, None)


def _stem(dataset: str) -> str:
    """A data set's name, also if given as D4RL's file: "hopper_medium-v2.hdf5"."""
    return Path(dataset).name.removesuffix(".hdf5").replace("_", "-")


def _plain(name: str) -> str:
    """The paper's name of a recipe that has other settings."""
    if name in paper_results():
        return name
    return name.removesuffix("-tuned").removesuffix("-protocol")


def _row(cell: Cell) -> str:
    interval = f" [{_number(cell.low)}, {_number(cell.high)}]" if cell.runs > 1 else ""
    known = cell.paper_mean == cell.paper_mean
    paper = f"{_number(cell.paper_mean)} ± {_number(cell.paper_std)}" if known else ""
    return (
        f"| {cell.label} | {cell.runs} | {_number(cell.mean)} ± {_number(cell.std)} "
        f"| {_number(cell.std_episodes)} | {_number(cell.iqm)}{interval} | {paper} |"
    )


def _number(value: float) -> str:
    """Formats a number: whole from 100 on, with one decimal below."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}"
