"""Figures of learning curves."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from textwrap import wrap

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from torchrl_tit.files import write_bytes_atomic

from ..metrics import parse_metrics, read_metrics
from ..run import Run
from .cell import Cell

# Maximum length of names, in letters, for which two fit side by side below a figure.
_WIDEST_OF_TWO = 40
# Maximum number of letters in a line beside a panel.
_WIDEST_LABEL = 26


def plot_run(run: Run) -> None:
    """Draws a run's learning curve into its folder.

    Args:
        run: a run folder with metrics.
    """
    recipe = run.recipe
    plot_learning_curve(
        run.folder / "metrics.csv", run.curve, title=recipe.name, offline=recipe.offline
    )


def plot_learning_curve(
    metrics: Path, picture: Path, *, title: str, window: int = 5, offline: bool = False
) -> None:
    """Draws returns of training episodes over environment steps.

    Args:
        metrics: a run's ``metrics.csv`` with the columns ``step`` and ``return_mean``.
        picture: the PNG file to write.
        title: title of the figure.
        window: batches over which the bold line is averaged.
        offline: whether to draw evaluation episodes over gradient steps instead.
    """
    steps, returns = _curve(read_metrics(metrics))
    smooth = np.array([returns[max(0, i - window + 1) : i + 1].mean() for i in range(len(returns))])
    figure = _figure(title, offline)
    (axes,) = figure.axes
    batch, batches = ("an evaluation", "evaluations") if offline else ("a batch", "batches")
    if not len(steps):
        axes.text(0.5, 0.5, "no episode has ended", ha="center", transform=axes.transAxes)
    marker = "o" if len(steps) == 1 else "None"  # a line through one point is invisible
    axes.plot(
        steps, returns, marker=marker, ls="-", c="C0", alpha=0.35, lw=1, label=f"mean of {batch}"
    )
    axes.plot(
        steps, smooth, marker=marker, ls="-", c="C0", lw=2, label=f"mean of {window} {batches}"
    )
    _write(figure, picture)


def plot_comparison(
    curves: Mapping[str, Sequence[Run]],
    picture: Path,
    *,
    title: str,
    points: int = 200,
    offline: bool = False,
) -> None:
    """Draws learning curves of several groups of runs: mean over the runs, band of one deviation.

    Args:
        curves: the runs (seeds) of each group, by the group's name; the names' common prefix, up to
            a "/", appears only in the title.
        picture: the PNG file to write.
        title: title of the figure, instead of the common part of the names.
        points: steps at which the runs are compared; between batches, returns are interpolated.
        offline: as for :func:`plot_learning_curve`.

    Raises:
        ValueError: if there is no return to draw.
    """
    levels = zip(*(name.split("/")[:-1] for name in curves), strict=False)
    shared = takewhile(lambda level: len(curves) > 1 and len(set(level)) == 1, levels)
    common = "".join(f"{level[0]}/" for level in shared)
    figure = _figure(title or common.rstrip("/"), offline)
    (axes,) = figure.axes
    for name, runs in curves.items():
        rows = (parse_metrics(run.read("metrics.csv"), run.folder / "metrics.csv") for run in runs)
        known = [(steps, returns) for steps, returns in map(_curve, rows) if len(steps)]
        if not known:
            continue
        grid = np.linspace(
            max(steps[0] for steps, _ in known), min(steps[-1] for steps, _ in known), points
        )
        returns = np.stack([np.interp(grid, *run) for run in known])
        mean, deviation = returns.mean(0), returns.std(0)
        label = name.removeprefix(common) + (f" ({len(known)} runs)" if len(known) > 1 else "")
        marker = "o" if grid[0] == grid[-1] else "None"
        (line,) = axes.plot(grid, mean, marker=marker, ls="-", linewidth=2, label=label)
        axes.fill_between(
            grid, mean - deviation, mean + deviation, color=line.get_color(), alpha=0.2, linewidth=0
        )
    if not axes.lines:
        folders = ", ".join(str(run.folder) for runs in curves.values() for run in runs)
        raise ValueError(f"there is nothing to draw: no episode has ended in {folders}")
    _write(figure, picture)


def plot_table(cells: Sequence[Cell], picture: Path) -> None:
    """Draws cells next to the paper's values, one panel for each task and measure.

    Args:
        cells: what :func:`~recipes.results.table.make_table` returns.
        picture: the PNG file to write.
    """
    tasks: dict[tuple[str, str], list[Cell]] = {}  # of one measure: scores are not returns
    for cell in cells:
        tasks.setdefault((cell.recipe.rpartition("/")[0], cell.measure), []).append(cell)
    columns = min(3, len(tasks))
    rows = -(-len(tasks) // columns)
    labels = {
        (task, measure): [_break(cell.label.removeprefix(f"{task}/")) for cell in group]
        for (task, measure), group in tasks.items()
    }
    breaks = max(label.count("\n") for group in labels.values() for label in group)
    height = 0.6 + (0.32 + 0.16 * breaks) * max(map(len, tasks.values()))
    figure = new_figure((4.2 * columns, height * rows + 0.6))
    panels = figure.subplots(rows, columns, squeeze=False).flatten()
    for axes, ((task, measure), group) in zip(panels, tasks.items(), strict=False):
        places = np.arange(len(group))
        # A single run has no interval.
        below = [cell.iqm - cell.low if cell.runs > 1 else 0 for cell in group]
        above = [cell.high - cell.iqm if cell.runs > 1 else 0 for cell in group]
        axes.errorbar(
            [cell.iqm for cell in group],
            places,
            xerr=[below, above],
            fmt="o",
            color="C0",
            capsize=3,
            label="interquartile mean, 95%",
        )
        axes.errorbar(
            [cell.paper_mean for cell in group],
            places + 0.22,
            xerr=[cell.paper_std for cell in group],
            fmt="s",
            color="grey",
            markersize=4,
            label="paper",
        )
        axes.set_yticks(places, labels[task, measure])
        axes.set(title=task, xlabel=measure, ylim=(len(group) - 0.4, -0.6))
        axes.grid(alpha=0.3)
    for axes in panels[len(tasks) :]:
        axes.set_visible(False)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    save_figure(figure, picture)


def _curve(metrics: Iterable[dict[str, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Steps and returns of the batches in which an episode ended."""
    rows = [row for row in metrics if not np.isnan(row["return_mean"])]
    return np.array([row["step"] for row in rows]), np.array([row["return_mean"] for row in rows])


def _break(label: str) -> str:
    """Breaks a label into lines that leave room for the panel."""
    return "\n".join(wrap(label, _WIDEST_LABEL))


def new_figure(size: tuple[float, float]) -> Figure:
    """Returns an empty figure of a width and a height in inches."""
    figure = Figure(figsize=size, dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _figure(title: str, offline: bool) -> Figure:
    figure = new_figure((7, 4))
    axes = figure.add_subplot()
    steps, episodes = ("gradient", "evaluation") if offline else ("environment", "training")
    axes.set(title=title, xlabel=f"{steps} steps", ylabel=f"return of {episodes} episodes")
    axes.grid(alpha=0.3)
    return figure


def _write(figure: Figure, picture: Path) -> None:
    (axes,) = figure.axes
    handles, labels = axes.get_legend_handles_labels()
    if len(handles) > 2:  # they would hide the curves
        columns = 2 if max(map(len, labels)) <= _WIDEST_OF_TWO else 1
        figure.set_figheight(4 + 0.3 * len(handles) / columns)
        figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)
    else:
        axes.legend(frameon=False)
    save_figure(figure, picture)


def save_figure(figure: Figure, picture: Path) -> None:
    """Writes a figure as PNG, whole or not at all."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", bbox_inches="tight")
    write_bytes_atomic(picture, buffer.getvalue())
