"""Prints the tables of docs/paper.md: each cell of the paper, and what was run for it.

A comment of that page names a function of :data:`TABLES` below:

    <!-- table: paper/1
    -->
    ...
    <!-- end -->

``python -m docs.tools.tables`` writes the table from the paper's numbers (recipes/tools/results)
and from all runs in docs/results, so a run that is recorded there fills its cell.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from statistics import fmean, median, stdev
from typing import Any

from recipes.core.recipe import Recipe, experiment_of
from recipes.core.registry import RECIPES, get_recipe
from recipes.tools.results.experiments import changes_of, fields_of, find_runs, read_metrics
from recipes.tools.results.interval import FEWEST
from recipes.tools.results.paper import (
    Match,
    PaperCell,
    hyperparameter_table,
    hyperparameters,
    match,
    paper_cells,
)
from recipes.tools.results.table import value_of
from torchrl_tit import EnhancedTIT, VanillaTIT
from torchrl_tit.analysis import Flows, count_flows
from torchrl_tit.scores import REFERENCE_RETURNS

RESULTS = Path(__file__).parents[1] / "results"
NOT_RUN = "*open*"

_PAGES = {
    "cartpole": "results/classic_control.md",
    "hopper": "results/classic_control.md",
    "breakout": "results/breakout/records.csv",
    "pong": "results/pong/records.csv",
}
"""What shows the tables of runs that have no page of their own name."""

EXPERT_SCORES = {
    "halfcheetah": ("-280.178953", "12135.0"),
    "hopper": ("-20.272305", "3234.3"),
    "walker": ("1.629008", "4592.3"),
}
"""The paper's table 8: a random and an expert score."""

FLOWS = {
    "Spatial": ("LK", "LK"),
    "Temporal": ("L", "L"),
    "S-S": ("(L-1)K", "(L-1)K"),
    "T-T": ("L-1", "L"),
    "S-T": ("K", "LK"),
    "T-S": ("0", "0"),
}
"""The paper's table 12: flows in Vanilla_TIT and in Enhanced_TIT."""


@dataclass(frozen=True)
class Measured:
    """Runs of the same settings for a cell of the paper."""

    match: Match
    recipe: Recipe
    page: str
    """The page that has them, below docs."""
    values: tuple[float, ...]
    """The mean return of each run, or its best score."""
    steps: int

    @property
    def is_near(self) -> bool:
        """Whether the runs have other settings than those of the cell."""
        return self.match.differs != self.match.cell.note

    @property
    def rank(self) -> tuple[bool, int, int]:
        """Comes first: enough runs; the recipes of today, then those of older versions."""
        name, few = self.recipe.name, len(self.values) < FEWEST
        if name in RECIPES and not changes_of(get_recipe(name), self.recipe):
            return few, 0, -len(self.values)
        return few, 1 if name.endswith("-tuned") else 2, -len(self.values)

    def __str__(self) -> str:
        """Mean and spread over the runs, with their number and steps."""
        digits = self.match.cell.digits
        numbers = [fmean(self.values), *([stdev(self.values)] if self.values[1:] else [])]
        number = "±".join(f"{one:.{digits}f}" for one in numbers)
        return f"[{number}]({self.page}) ({len(self.values)}x{_steps(self.steps)})"


def _steps(count: int) -> str:
    return f"{count / 1e6:.0f}M" if count >= 10**6 else f"{count / 1e3:.0f}k"


@cache
def measured() -> dict[PaperCell, list[Measured]]:
    """Finds the runs of docs/results that belong to cells of the paper."""
    groups: dict[Any, list[Any]] = defaultdict(list)
    for run in find_runs([RESULTS]):
        recipe = run.recipe
        found, evaluation = match(recipe), run.read_evaluation()
        if found is not None and evaluation is not None:
            page = run.folder.relative_to(RESULTS).parts[0]
            groups[page, experiment_of(recipe)].append((found, evaluation))
    cells: dict[PaperCell, list[Measured]] = defaultdict(list)
    for (page, recipe), runs in groups.items():
        found = runs[0][0]
        values = [value_of(evaluation) for _, evaluation in runs]
        steps = min(evaluation["steps"] for _, evaluation in runs)
        cells[found.cell].append(
            Measured(found, recipe, _PAGES.get(page, f"results/{page}.md"), tuple(values), steps)
        )
    return {cell: sorted(found, key=lambda one: one.rank) for cell, found in cells.items()}


def ours(cell: PaperCell) -> list[str]:
    """What was run for a cell: with its settings, or not, and the runs that are nearest to it."""
    found = measured().get(cell, [])
    lines: list[str] = []
    if not cell.recipes:  # the head of its row or column says it
        return lines
    for name in cell.recipes:
        own = [one for one in found if not one.is_near and one.recipe.name == name]
        label = ("paper: " if name.endswith("-paper") else "code: ") * (len(cell.recipes) > 1)
        lines.append(f"{label}{own[0] if own else NOT_RUN}")
    if not any("](" in line for line in lines):
        lines = [NOT_RUN]
    near = [one for one in found if one.is_near]
    return [*lines, f"near {near[0]}"] if near else lines


def print_cell(cell: PaperCell) -> str:
    """The paper's number, and below it ours."""
    number = str(cell).replace(" ", "")
    if cell.curves_std == cell.curves_std:
        number += f" (curves ±{cell.curves_std:g})"
    return "<br>".join([number, *ours(cell)])


def _grid(cells: Sequence[PaperCell], rows: str, columns: str, corner: str) -> str:
    """A table of cells, by the attributes that stand in its rows and columns."""
    heads = dict.fromkeys(getattr(cell, columns) for cell in cells)
    lines: dict[str, dict[str, str]] = {}
    for cell in cells:
        row = lines.setdefault(getattr(cell, rows), {})
        row[getattr(cell, columns)] = print_cell(cell)
    names = {}
    for cell in (cell for cell in cells if cell.recipes):
        algorithm, task, network = cell.recipes[0].split("/")
        names[cell.network] = network
        if algorithm == "ppo":
            names[cell.task] = task
        else:  # the version of the data
            names[cell.network] = f"{algorithm}/DATA{task.removeprefix(cell.task)}/{network}"
    quoted = {cell.network for cell in cells if not cell.recipes}

    def head(name: str) -> str:
        if name in quoted:
            return f"{name}: quoted, not run"
        return f"{name} `{names[name]}`" if name in names else name

    return _table(
        [corner, *map(head, heads)],
        [[head(name), *(row.get(column, "") for column in heads)] for name, row in lines.items()],
    )


def _table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    first, *lines = (f"| {' | '.join(map(str, line))} |" for line in [head, *rows])
    return "\n".join([first, "|" + "---|" * len(head), *lines]) + "\n"


def _in(*tables: str) -> list[PaperCell]:
    return [cell for cell in paper_cells() if {*tables} & {*cell.tables}]


def _by_network(*tables: str) -> str:
    return _grid(_in(*tables), "network", "task", "network")


def _offline() -> str:
    return _grid(_in("3", "10"), "task", "network", "data")


def _counts() -> str:
    rows = []
    for title, tables in {"1": "1", "2": "2", "3": "3", "4 and 11": "4 11", "10": "10"}.items():
        cells = [cell for cell in _in(*tables.split()) if cell.mean == cell.mean]
        kinds: Counter[str] = Counter()
        for cell in cells:
            text = " ".join(ours(cell))
            if not cell.recipes:
                kinds["quoted"] += 1
            elif any(not one.is_near for one in measured().get(cell, [])):
                kinds["run"] += 1
            else:
                kinds["near" if "near" in text else "not"] += 1
        counts = (kinds[kind] for kind in ("quoted", "run", "near", "not"))
        rows.append([title, len(cells), *counts])
    head = ["table", "numbers", "quoted by the paper", "run here", "only near", "not run"]
    return _table(head, rows)


@dataclass(frozen=True)
class Need:
    """What a run of some cells needs."""

    tables: str
    begins: tuple[str, ...]
    """How the names of their recipes begin."""
    data: str
    speed_of: str
    """A run in docs/results that is as fast."""


_NEEDS = {
    "Atari, convolutions": Need("1 4 11", ("ppo/",), "extra `atari`", "pong/nature-cnn"),
    "Atari, TIT": Need("1 4 11", ("ppo/",), "extra `atari`", "pong/enhanced-tit"),
    "Ant, Walker2d": Need("2", ("ppo/ant", "ppo/walker2d"), "", "hopper/mlp/seed-0"),
    "CQL": Need("3", ("cql/",), "D4RL v0, downloaded by name", "cql/hopper-mixed/mlp/seed-0"),
    "DT": Need(
        "3", ("dt/",), "D4RL v2, downloaded by name", "decision_transformer/hopper-medium/dt/seed-0"
    ),
}


def _needs() -> str:
    rows = []
    for title, need in _NEEDS.items():
        cells = [
            cell
            for cell in _in(*need.tables.split())
            if cell.recipes and cell.recipes[0].startswith(need.begins)
        ]
        if title.startswith("Atari"):
            is_tit = title.endswith("TIT")
            cells = [cell for cell in cells if is_tit == ("-tit" in cell.recipes[0])]
        cells = [cell for cell in cells if all(one.is_near for one in measured().get(cell, []))]
        cells = [cell for cell in cells if cell.mean == cell.mean]
        steps = get_recipe(cells[0].recipes[0]).final_step if cells else 0
        (run,) = find_runs([RESULTS / need.speed_of])
        speeds = [row["steps_per_second"] for row in read_metrics(run)]
        rate = median(speed for speed in speeds if speed == speed)
        hours = f"{steps / rate / 3600:.0f}"
        rows.append([title, len(cells), need.data, f"{steps:,}", hours])
    return _table(["cells", "number", "needs", "steps of a run", "hours"], rows)


def _hyperparameters() -> str:
    tables = {"5": "Atari", "6": "arrays", "7": "CQL_TIT", "9": "DT_TIT"}
    recipes: dict[str, list[dict[str, Any]]] = {table: [] for table in tables}
    for cell in paper_cells():
        if cell.recipes and "TIT" in cell.network:
            recipes[hyperparameter_table(cell)].append(fields_of(get_recipe(cell.recipes[0])))
    names = dict.fromkeys(row.name for row in hyperparameters("5") if row.name)

    def used(table: str, field: str) -> str:
        values = Counter(recipe[field] for recipe in recipes[table] if field in recipe)
        return ", ".join("-" if value is None else str(value) for value, _ in values.most_common())

    def show(table: str, name: str) -> str:
        (row,) = (row for row in hyperparameters(table) if row.name == name)
        here = used(table, row.fields[0])
        if "observation size" in row.values:  # is a number that depends on the data
            here = "observation size"
        values = ", ".join(row.values)
        return values if values == here else f"{values} / {here}"

    def unlisted(field: str) -> list[str]:
        return [f"- / {used(table, field)}" for table in tables]

    rows = [[name, *(show(table, name) for table in tables)] for name in names]
    for name, field in {
        "ffn expansion of inner, of outer block": "backbone.frame.ffn_expansion",
        "features": "backbone.head.features_dim",
        "activation of the head": "backbone.head.activation",
        "position encoding": "backbone.frame.position_encoding",
    }.items():
        rows.append([name, *unlisted(field)])
    return _table(["", *(f"{table}: {title}" for table, title in tables.items())], rows)


def _scores() -> str:
    rows = []
    for task, printed in EXPERT_SCORES.items():
        here = next(pair for name, pair in REFERENCE_RETURNS.items() if name.startswith(task))
        rows.append([task, *map(_or_same, printed, map(str, here))])
    return _table(["task", "random", "expert"], rows)


def _or_same(paper: str, here: str) -> str:
    return paper if paper == here else f"{paper} / {here}"


def _flows() -> str:
    blocks, steps = 2, 4
    values = {
        "0": 0, "K": steps, "L": blocks, "L-1": blocks - 1, "LK": blocks * steps,
        "(L-1)K": (blocks - 1) * steps,
    }  # fmt: skip
    counted = [
        count_flows(make((4,), num_frames=steps, num_blocks=blocks))
        for make in (VanillaTIT, EnhancedTIT)
    ]
    rows = []
    for (name, formulas), field in zip(FLOWS.items(), fields(Flows), strict=False):
        pairs = zip(formulas, counted, strict=True)
        numbers = [(f, str(values[f]), str(getattr(flows, field.name))) for f, flows in pairs]
        rows.append([name, *(f"{f}: {_or_same(paper, here)}" for f, paper, here in numbers)])
    return _table(["flow", "Vanilla_TIT", "Enhanced_TIT"], rows)


TABLES: dict[str, Callable[[], str]] = {
    "1": lambda: _by_network("1"),
    "2": lambda: _by_network("2"),
    "3": _offline,
    "4": lambda: _by_network("4", "11"),
    "hyperparameters": _hyperparameters,
    "8": _scores,
    "12": _flows,
    "counts": _counts,
    "needs": _needs,
}
"""The tables of the page."""
