"""The tables of the paper for runs, beside what the paper and others report."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from statistics import fmean, stdev
from textwrap import fill
from typing import Any

from torchrl_tit.scores import has_reference

from ...core import records
from ...core.numbers import mean_std, number, numbers
from ...core.recipe import Recipe
from ...core.registry import RECIPES
from ...core.run import Run
from .experiments import Experiment, find_runs, group_runs, label
from .interval import FEWEST, Interval, interval_of
from .package_rows import read_rows
from .paper import HEADINGS, TASK, Match, has_its_data, match, paper_cells, plain_name
from .plot import new_figure, plain, save_figure

OTHER = "not in the paper"
FEW = f"Fewer than {FEWEST} runs have no interquartile mean, and say little about others."
_WIDEST_LABEL = 26  # letters in a line beside a panel
HEADER = (
    *("recipe", "runs", "mean ± sample deviation over runs", "± over episodes"),
    *("interquartile mean [95%]", "paper"),
)
"""The header of :func:`to_columns`."""


@dataclass(frozen=True)
class Published:
    """The result of another implementation with the same kind of network."""

    source: str
    """Who reports it."""
    url: str
    """Where."""
    mean: float
    std: float
    """NaN if none is reported."""
    note: str
    """How it was measured: version of the task, steps, seeds."""

    @property
    def numbers(self) -> str:
        """The mean, and the spread if there is one."""
        return " ± ".join(numbers([self.mean, *([self.std] * (self.std == self.std))]))


@dataclass(frozen=True)
class Cell:
    """All runs of the same settings: one cell of a table.

    A run's value is the mean return of its last weights, or their normalized score if it has one
    (offline recipes).
    """

    table: str
    """The paper's table that it belongs to."""
    recipe: str
    runs: int
    steps: int
    """Training steps; the minimum over the runs."""
    mean: float
    """Mean of the runs' values."""
    std: float
    """Sample standard deviation of the runs' values; NaN for a single run."""
    std_episodes: float
    """Standard deviation over the episodes of a run, as the paper's online tables seem to report
    it; the mean over the runs."""
    iqm: float
    """Interquartile mean of the runs' values (arXiv 2108.13264); NaN for fewer than five runs."""
    low: float
    """Lower end of its 95% confidence interval, by bootstrap over runs; NaN as above."""
    high: float
    """Upper end."""
    paper_mean: float
    """The paper's value for the same task and kind of network; NaN if it has none."""
    paper_std: float
    """As the paper prints it."""
    paper: str = ""
    """The paper's value as text: marked as near, with what differs, unless the runs have the
    settings that it was measured with."""
    changes: str = ""
    """Fields in which the runs differ from the recipe of that name, with the runs' values."""

    measure: str = "return"
    """What the values are: "return" or "normalized score"."""

    published: tuple[Published, ...] = ()
    """What others report for the same task and kind of network."""

    values: tuple[float, ...] = ()
    """The runs' values."""

    best: float = float("nan")
    """Mean of the runs' highest evaluations during training, as the paper reports them offline; NaN
    if there are none. The highest of many noisy means is biased upwards."""

    @property
    def label(self) -> str:
        """The recipe's name, and the changed fields."""
        return label(self.recipe, self.changes)


def make_table(folders: Iterable[Path]) -> tuple[list[Cell], list[str]]:
    """Reads run folders and groups runs of the same settings, ignoring seeds.

    Args:
        folders: run folders, or folders with run folders somewhere below.

    Returns:
        The cells, in the paper's order, and the notes of :func:`read_evaluations`.

    Raises:
        ValueError: if there is no evaluated run, or two runs of the same settings have the same
            seed.
    """
    folders = list(folders)
    experiments, notes = read_evaluations(folders)
    if not experiments:
        raise ValueError(
            f"no evaluated run in {', '.join(map(str, folders))}" + "".join(f"; {n}" for n in notes)
        )
    cells = [_cell(experiment, evaluations) for experiment, evaluations in experiments]
    order = {
        plain_name(name): place for place, cell in enumerate(paper_cells()) for name in cell.recipes
    }
    last = len(order)
    cells.sort(key=lambda x: (x.table == OTHER, order.get(plain_name(x.recipe), last), x.label))
    return cells, notes


def read_evaluations(
    folders: Iterable[Path],
) -> tuple[list[tuple[Experiment, list[dict[str, Any]]]], list[str]]:
    """Reads the evaluations of runs that are complete.

    Args:
        folders: as for :func:`make_table`.

    Returns:
        Experiments in the order of their first runs, with the evaluation of each run, and a note
        for each run that is left out, was evaluated over a different number of episodes than its
        recipe says, or changed its length while schedules followed it.
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
        if "returns" not in evaluation:
            notes.append(f"{run.folder} is left out: it has no environment, and so no returns")
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
    return [
        (experiment, [evaluations[run.folder] for run in experiment.runs])
        for experiment in group_runs(runs)
    ], notes


def to_markdown(cells: Sequence[Cell]) -> str:
    """Writes cells as Markdown, one table for each of the paper's.

    Where others have published results for the same task and network, the table has a column for
    them, and where runs learned from data, one for their highest evaluations.
    """
    parts = []
    for table in dict.fromkeys(cell.table for cell in cells):
        rows = [cell for cell in cells if cell.table == table]
        is_published = any(cell.published for cell in rows)
        has_best = any(cell.best == cell.best for cell in rows)
        columns = [*HEADER, *["highest evaluation"] * has_best, *["published"] * is_published]
        texts = (
            [
                *to_columns(cell),
                *[number(cell.best)] * has_best,
                *[", ".join(map(_published, cell.published))] * is_published,
            ]
            for cell in rows
        )
        lines = [f"### {table[0].upper()}{table[1:]}\n", *to_lines(columns, texts)]
        if any(cell.runs < FEWEST for cell in rows):
            lines += ["", FEW]
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def to_columns(cell: Cell) -> list[str]:
    """Writes the numbers of a cell as text, under :data:`HEADER`."""
    return [
        cell.label,
        str(cell.runs),
        mean_std(cell.values),
        number(cell.std_episodes),
        str(Interval(cell.iqm, cell.low, cell.high)),
        cell.paper,
    ]


def to_csv(cells: Sequence[Cell]) -> str:
    """Writes cells as CSV, one row each; unknown values are empty, published ones are one text."""
    names = [field.name for field in fields(Cell)]
    rows = []
    for cell in cells:
        values = {name: getattr(cell, name) for name in names}
        values["values"] = "; ".join(map(str, cell.values))
        values["published"] = "; ".join(
            f"{result.source} {result.mean} ± {result.std} ({result.note}; {result.url})"
            for result in cell.published
        )
        rows.append(["" if value != value else value for value in values.values()])
    return records.to_csv([names, *rows])


def plot_table(cells: Sequence[Cell], picture: Path) -> None:
    """Draws cells next to the paper's values, one panel for each task and measure.

    Args:
        cells: what :func:`make_table` returns.
        picture: the PNG file to write.
    """
    tasks: dict[tuple[str, str], list[Cell]] = {}  # of one measure: scores are not returns
    for cell in cells:
        tasks.setdefault((cell.recipe.rpartition("/")[0], cell.measure), []).append(cell)
    labels = {
        (task, measure): [
            fill(plain(cell.label.removeprefix(f"{task}/")), _WIDEST_LABEL) for cell in group
        ]
        for (task, measure), group in tasks.items()
    }
    breaks = max(label.count("\n") for group in labels.values() for label in group)
    height = 0.6 + (0.32 + 0.16 * breaks) * max(map(len, tasks.values()))
    columns = min(3, len(tasks))
    rows = -(-len(tasks) // columns)
    figure = new_figure((4.2 * columns, height * rows + 0.6))
    panels = figure.subplots(rows, columns, squeeze=False).flatten()
    shown: dict[str, Any] = {}  # what the legend names
    for axes, ((task, measure), group) in zip(panels, tasks.items(), strict=False):
        for place, cell in enumerate(group):
            if cell.runs >= FEWEST:
                ends = [[cell.iqm - cell.low], [cell.high - cell.iqm]]
                label = "interquartile mean, 95%"
                shown[label] = axes.errorbar(cell.iqm, place, xerr=ends, fmt="o", c="C0", capsize=3)
            else:
                label = f"mean of fewer than {FEWEST} runs"
                (shown[label],) = axes.plot(cell.mean, place, "o", c="C0", mfc="none")
            if cell.paper:
                shown["paper"] = axes.errorbar(
                    cell.paper_mean, place + 0.22, xerr=cell.paper_std, fmt="s", c="grey", ms=4
                )
        axes.set_yticks(range(len(group)), labels[task, measure])
        axes.set(title=task, xlabel=measure, ylim=(len(group) - 0.4, -0.6))
        axes.grid(alpha=0.3)
    for axes in panels[len(tasks) :]:
        axes.set_visible(False)
    figure.legend(shown.values(), shown, loc="outside lower center", ncols=len(shown))
    save_figure(figure, picture)


@cache
def published_results() -> dict[str, tuple[Published, ...]]:
    """What others have published, by the name of the recipe with the same task and network.

    Example:
        >>> [result.source for result in published_results()["ppo/acrobot/mlp"]]
        ['CleanRL', 'RL Zoo']
    """
    results: dict[str, tuple[Published, ...]] = {}
    for row in read_rows("published_results.csv"):
        name = row["recipe"]
        mean, std = float(row["mean"]), float(row["std"])
        result = Published(row["source"], row["url"], mean, std, row["note"])
        results[name] = (*results.get(name, ()), result)
    return results


def reported_of(recipe: Recipe) -> tuple[Match | None, tuple[Published, ...]]:
    """What the paper reports about a run's cell, and others about the recipe of its name.

    Args:
        recipe: the settings of a run.
    """
    plain = plain_name(recipe.name)
    named = RECIPES.get(recipe.name) or RECIPES.get(plain)
    fields = [*TASK, "backbone"] if named and has_its_data(recipe) else []
    same = all(getattr(recipe, x, None) == getattr(named, x, None) for x in fields)
    return match(recipe), published_results().get(plain, ()) if fields and same else ()


def value_of(evaluation: dict[str, Any]) -> float:
    """The number that a run counts with: the mean return, or the normalized score, at the end."""
    return float(evaluation["score"]["last"] if "score" in evaluation else evaluation["mean"])


def measure_of(recipe: Recipe, evaluation: dict[str, Any]) -> str:
    """What :func:`value_of` is: "return" or "normalized score"."""
    return "normalized score" if "score" in evaluation and has_reference(recipe.env) else "return"


def _earlier_lengths(run: Run, lengths: Sequence[tuple[int, int]]) -> str:
    field, schedules = run.recipe.length, ", ".join(run.recipe.schedules)
    before = ", ".join(f"{length} until step {step}" for step, length in lengths)
    return f"{run.folder} changed its length: for {schedules}, {field} was {before}"


def _cell(experiment: Experiment, evaluations: Sequence[dict]) -> Cell:
    values = [value_of(evaluation) for evaluation in evaluations]
    spreads = [evaluation.get("score_std", evaluation["std"]) for evaluation in evaluations]
    interval = interval_of(values)
    found, published = reported_of(experiment.settings)
    paper = found.cell if found else None
    return Cell(
        table=HEADINGS[paper.tables[0]] if paper else OTHER,
        recipe=experiment.name,
        runs=len(values),
        steps=min(evaluation["steps"] for evaluation in evaluations),
        mean=fmean(values),
        std=stdev(values) if len(values) > 1 else float("nan"),
        std_episodes=fmean(spreads),
        iqm=interval.middle if len(values) >= FEWEST else float("nan"),
        low=interval.low,
        high=interval.high,
        paper_mean=paper.mean if paper else float("nan"),
        paper_std=paper.std if paper else float("nan"),
        paper=str(found or ""),
        changes=experiment.changes,
        measure=measure_of(experiment.settings, evaluations[0]),
        published=published,
        values=tuple(values),
        best=fmean(x["score"]["best"] if "score" in x else float("nan") for x in evaluations),
    )


def _published(result: Published) -> str:
    return f"[{result.source}]({result.url}) {result.numbers} ({result.note})"


def to_lines(header: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Writes a Markdown table."""
    first, *lines = (f"| {' | '.join(columns)} |" for columns in (header, *rows))
    return [first, "|---" * len(header) + "|", *lines]
