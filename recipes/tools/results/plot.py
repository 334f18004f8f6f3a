"""Figures of runs: learning curves, other metrics, and tables, drawn with Matplotlib."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchrl_tit.files import write_bytes_atomic

from ...core.recipe import Recipe
from ...core.run import Run
from .experiments import Experiment, common_part, read_metrics
from .interval import FEWEST, intervals_of

NEARLY = 0.9
"""A run that has fewer steps than this share of its longest sibling is left out of bold lines."""
WINDOW = 5
"""Points of a curve over which returns of training are averaged in bold lines."""
_LINES = ("-", "--", ":", "-.")
_MOST_SINGLE = 9  # more runs would hide the bold lines
_POINTS = 400  # of a curve; of longer ones, neighbors are averaged
_GRID = 200  # points at which runs with different steps are compared
_WIDEST = 60  # letters in a line of a legend


@dataclass(frozen=True)
class Curve:
    """A metric of a run where it is known, or its interquartile mean over runs.

    Args:
        steps: float [points].
        values: float [points].
        end: steps that the run has made; None for those of the last point.
    """

    steps: np.ndarray
    values: np.ndarray
    end: float | None = None

    @property
    def length(self) -> float:
        """The steps that the run has made."""
        return self.steps[-1] if self.end is None else self.end


def curve_of(rows: Sequence[Mapping[str, float]], column: str = "return_mean") -> Curve:
    """Returns a metric at the steps where it is known; of more than 400 rows, means of neighbors.

    Args:
        rows: the rows of a ``metrics.csv``.
        column: the metric.

    Example:
        >>> curve_of([{"step": 1, "return_mean": np.nan}, {"step": 2, "return_mean": 9.0}]).values
        array([9.])
    """
    pairs = [(row["step"], row[column]) for row in rows if np.isfinite(row.get(column, np.nan))]
    steps, values = np.array(pairs).reshape(-1, 2).T
    if (size := -(-len(steps) // _POINTS)) > 1:
        starts = np.arange(0, len(steps), size)
        counts = np.diff(starts, append=len(steps))
        values = np.add.reduceat(values, starts) / counts
        steps = steps[starts + counts - 1]
    return Curve(steps, values, rows[-1]["step"] if rows else None)


def draw_curves(
    axes: Axes, groups: Mapping[str, Sequence[Curve]], window: int = 1
) -> dict[str, Curve]:
    """Draws curves: thin lines for single runs, bold ones for interquartile means with bands.

    Bands are 95% bootstrap intervals. Of fewer than five runs, bold lines are means without a band.
    If all runs together are more than nine, there are no thin lines.

    Args:
        axes: where to draw.
        groups: the curves of each group's runs by the group's name. Runs that have made fewer than
            90% of the steps of the longest one are left out of bold lines, which end where the
            first of the others has its last value.
        window: points over which bold lines are averaged.

    Returns:
        The bold line of each group that has one.
    """
    known = {name: [run for run in runs if len(run.steps)] for name, runs in groups.items()}
    few = sum(map(len, known.values())) <= _MOST_SINGLE
    bold = {}
    for index, (name, runs) in enumerate(known.items()):
        if not runs:
            continue
        color, line = f"C{index % 10}", _LINES[index // 10 % len(_LINES)]
        for run in runs if few and (len(runs) > 1 or window > 1) else ():
            axes.plot(run.steps, run.values, c=color, ls=line, lw=1, alpha=0.35)
        longest = max(run.length for run in runs)
        whole = [run for run in runs if run.length >= NEARLY * longest]
        steps, values = _on_one_grid([_smoothed(run, window) for run in whole])
        middle, low, high = intervals_of(values)
        label = f"{name} ({len(whole)} runs)" if len(whole) > 1 else name
        marker = "o" if len(steps) == 1 else None  # a line through one point is invisible
        axes.plot(steps, middle, c=color, ls=line, lw=2, marker=marker, label=plain(label))
        if len(whole) >= FEWEST:
            axes.fill_between(steps, low, high, color=color, alpha=0.2, lw=0)
        bold[name] = Curve(steps, middle)
    return bold


def short_runs(label: str, steps: Mapping[str, int]) -> list[str]:
    """Names the runs that bold lines leave out, because they are shorter than the others.

    Args:
        label: the name of their group.
        steps: the steps of each run by its name.

    Example:
        >>> short_runs("mlp", {"seed 0": 1000, "seed 1": 400})
        ['mlp, seed 1 is at 400 of 1,000 steps: bold lines leave it out']
    """
    longest = max(steps.values(), default=0)
    return [
        f"{label}, {name} is at {step:,} of {longest:,} steps: bold lines leave it out"
        for name, step in steps.items()
        if step < NEARLY * longest
    ]


def plot_run(run: Run) -> None:
    """Draws a run's learning curve into its folder.

    Args:
        run: a run folder with metrics.
    """
    offline = run.recipe.offline
    figure, axes = new_chart(run.recipe.name, run.recipe)
    name = "evaluations" if offline else "moving average"
    if draw_curves(axes, {name: [_learning_curve(run)]}, 1 if offline else WINDOW):
        add_legend(figure)
    else:
        axes.text(0.5, 0.5, "no episode has ended", ha="center", transform=axes.transAxes)
    save_figure(figure, run.curve)


def plot_comparison(experiments: Sequence[Experiment], picture: Path, *, title: str) -> list[str]:
    """Draws learning curves of experiments, as :func:`draw_curves` does.

    Args:
        experiments: the experiments; what their names have in common appears only in the title.
        picture: the PNG file to write.
        title: title of the figure, instead of the common part of the names.

    Returns:
        What :func:`short_runs` says of each experiment.

    Raises:
        ValueError: if there is no return to draw.
    """
    recipe = experiments[0].settings
    common = common_part([experiment.name for experiment in experiments])
    figure, axes = new_chart(title or common.rstrip("/"), recipe)
    curves = {
        experiment.label.removeprefix(common): [*map(_learning_curve, experiment.runs)]
        for experiment in experiments
    }
    if not draw_curves(axes, curves, 1 if recipe.offline else WINDOW):
        folders = ", ".join(str(run.folder) for one in experiments for run in one.runs)
        raise ValueError(
            f"there is nothing to draw: no episode has ended in {folders}, or no row of metrics "
            "was written, if log_interval is longer than the run"
        )
    add_legend(figure)
    save_figure(figure, picture)
    notes = []
    for experiment, found in zip(experiments, curves.values(), strict=True):
        seeds = [f"seed {run.recipe.seed}" for run in experiment.runs]
        ends = {x: int(y.length) for x, y in zip(seeds, found, strict=True) if len(y.steps)}
        notes += short_runs(experiment.label, ends)
    return notes


def _learning_curve(run: Run) -> Curve:
    """The returns of a run; without an environment, the error on held-out episodes."""
    rows, column = read_metrics(run), "return_mean"
    if rows and not run.recipe.env:
        column = next((name for name in rows[0] if name.startswith("held_out_")), column)
    return curve_of(rows, column)


def new_chart(title: str, recipe: Recipe) -> tuple[Figure, Axes]:
    """Returns a figure with axes for the learning curves of a recipe."""
    figure = new_figure((7, 4))
    axes = figure.add_subplot()
    steps, episodes = ("gradient", "evaluation") if recipe.offline else ("environment", "training")
    what = f"return of {episodes} episodes" if recipe.env else "error on held-out episodes"
    axes.set(title=plain(title), xlabel=f"{steps} steps", ylabel=what)
    axes.grid(alpha=0.3)
    return figure, axes


def add_legend(figure: Figure) -> None:
    """Adds a legend: in the axes, or below them where it would hide the curves."""
    (axes,) = figure.axes
    handles, labels = axes.get_legend_handles_labels()
    labels = [fill(label, _WIDEST) for label in labels]
    if len(handles) > 2:
        columns = 2 if max(map(len, labels)) <= _WIDEST / 2 else 1
        lines = sum(label.count("\n") + 1 for label in labels) / columns
        figure.set_figheight(4 + 0.3 * lines)
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)
    else:
        axes.legend(handles, labels, frameon=False)


def new_figure(size: tuple[float, float]) -> Figure:
    """Returns an empty figure of a width and a height in inches."""
    return Figure(figsize=size, dpi=120, layout="constrained")


def save_figure(figure: Figure, picture: Path) -> None:
    """Writes a figure as PNG, whole or not at all."""
    write_bytes_atomic(picture, to_bytes(figure, "png"))


def to_bytes(figure: Figure, kind: str) -> bytes:
    """Returns a figure as the content of a file, "png" or "svg"."""
    buffer = io.BytesIO()
    metadata = {"Date": None} if kind == "svg" else None
    figure.savefig(buffer, format=kind, bbox_inches="tight", metadata=metadata)
    return buffer.getvalue()


def _on_one_grid(curves: Sequence[Curve]) -> tuple[np.ndarray, np.ndarray]:
    """The steps that curves have in common, and their values there, [curves, steps]."""
    first = curves[0].steps
    if all(np.array_equal(curve.steps, first) for curve in curves):
        return first, np.stack([curve.values for curve in curves])
    start = max(curve.steps[0] for curve in curves)
    end = max(start, min(curve.steps[-1] for curve in curves))
    grid = np.linspace(start, end, _GRID)
    return grid, np.stack([np.interp(grid, curve.steps, curve.values) for curve in curves])


def _smoothed(curve: Curve, window: int) -> Curve:
    """The means of each value and those before it."""
    sums = np.cumsum([0.0, *curve.values])
    ends = np.arange(1, len(sums))
    starts = np.maximum(ends - window, 0)
    return Curve(curve.steps, (sums[ends] - sums[starts]) / (ends - starts))


def plain(text: str) -> str:
    """A name of others, in which Matplotlib would read "$" as the beginning of a formula."""
    return text.replace("$", r"\$")
