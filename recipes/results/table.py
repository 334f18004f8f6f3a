"""From run folders to the paper's tables."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from torchrl_tit.datasets import has_reference

from ..recipe import Recipe
from ..run import Run
from .cell import Cell
from .experiments import Experiment, find_runs, group_runs
from .interval import interval_of
from .reported import Published, paper_results, plain_name, reported_of

OTHER = "not in the paper"


def make_table(folders: Iterable[Path]) -> tuple[list[Cell], list[str]]:
    """Reads run folders and groups runs of the same settings, ignoring seeds.

    Args:
        folders: run folders, or folders with run folders somewhere below.

    Returns:
        The cells, in the paper's order, and a note for each run that is left out, was evaluated
        over a different number of episodes than its recipe says, or changed its length
        while schedules followed it.

    Raises:
        ValueError: if there is no evaluated run, or two runs of the same settings have the same
            seed.
    """
    evaluations: dict[Path, dict] = {}
    runs, notes = [], []
    for run in find_runs(folders):
        try:
            evaluation = run.read_evaluation()
        except (OSError, ValueError) as error:
            notes.append(f"{run.folder} is left out: {error}")
            continue
        if evaluation is None:
            notes.append(f"{run.folder} is left out: it has no evaluation yet")
            continue
        if evaluation["steps"] < run.recipe.final_step:
            notes.append(
                f"{run.folder} is left out: evaluated after {evaluation['steps']} of "
                f"{run.recipe.final_step} steps"
            )
            continue
        asked = run.recipe.evaluation_episodes
        if (episodes := evaluation["episodes"]) != asked:  # `evaluate --episodes`
            notes.append(f"{run.folder} was evaluated over {episodes} episodes, not {asked}")
        if lengths := run.earlier_lengths():
            notes.append(_earlier_lengths(run, lengths))
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
        place = order.get(plain_name(cell.recipe), len(order))
        return cell.table == OTHER, place, cell.label

    cells.sort(key=rank)
    return cells, notes


def to_markdown(cells: Sequence[Cell]) -> str:
    """Writes cells as Markdown, one table for each of the paper's.

    Where others have published results for the same task and network, the table has a column for
    them.
    """
    parts = []
    for table in dict.fromkeys(cell.table for cell in cells):
        rows = [cell for cell in cells if cell.table == table]
        columns = ["recipe", "runs", "mean ± over runs", "± over episodes"]
        columns += ["interquartile mean [95%]", "paper"]
        published = any(cell.published for cell in rows)
        columns += ["published"] if published else []
        lines = [f"### {table[0].upper()}{table[1:]}\n", _line(columns)]
        lines += ["|---" * len(columns) + "|"]
        lines += [_line(_row(cell)[: len(columns)]) for cell in rows]
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def to_csv(cells: Sequence[Cell]) -> str:
    """Writes cells as CSV, one row each; unknown values are empty, published ones are one text."""
    buffer = io.StringIO()
    names = [field.name for field in fields(Cell)]
    writer = csv.DictWriter(buffer, names, lineterminator="\n")
    writer.writeheader()
    for cell in cells:
        values = {name: getattr(cell, name) for name in names}
        values["published"] = "; ".join(
            f"{result.source} {result.mean} ± {result.std} ({result.note}; {result.url})"
            for result in cell.published
        )
        writer.writerow({k: "" if v != v else v for k, v in values.items()})
    return buffer.getvalue()


def _value(evaluation: dict) -> float:
    return float(evaluation["score"]["best"] if "score" in evaluation else evaluation["mean"])


def _measure(recipe: Recipe, evaluation: dict) -> str:
    return "normalized score" if "score" in evaluation and has_reference(recipe.env) else "return"


def _earlier_lengths(run: Run, lengths: Sequence[tuple[int, int]]) -> str:
    field, schedules = run.recipe.length, ", ".join(run.recipe.schedules)
    before = ", ".join(f"{length} until step {step}" for step, length in lengths)
    return f"{run.folder} changed its length: for {schedules}, {field} was {before}"


def _cell(experiment: Experiment, evaluations: Sequence[dict]) -> Cell:
    values = np.array([_value(evaluation) for evaluation in evaluations])
    spreads = [evaluation.get("score_std", evaluation["std"]) for evaluation in evaluations]
    interval = interval_of(values)
    paper, published = reported_of(experiment.settings)
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
        published=published,
    )


def _row(cell: Cell) -> list[str]:
    interval = f" [{_number(cell.low)}, {_number(cell.high)}]" if cell.runs > 1 else ""
    known = cell.paper_mean == cell.paper_mean
    return [
        cell.label,
        str(cell.runs),
        f"{_number(cell.mean)} ± {_number(cell.std)}",
        _number(cell.std_episodes),
        f"{_number(cell.iqm)}{interval}",
        f"{_number(cell.paper_mean)} ± {_number(cell.paper_std)}" if known else "",
        ", ".join(map(_published, cell.published)),
    ]


def _published(result: Published) -> str:
    numbers = f"{_number(result.mean)} ± {_number(result.std)}"
    return f"[{result.source}]({result.url}) {numbers} ({result.note})"


def _line(columns: Sequence[str]) -> str:
    return f"| {' | '.join(columns)} |"


def _number(value: float) -> str:
    """Formats a number: whole from 100 on, with one decimal below."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}"
