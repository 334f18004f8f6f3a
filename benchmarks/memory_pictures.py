"""Pictures of runs on memory tasks: ``python -m benchmarks.memory_pictures lengths RUNS.CSV``.

``lengths`` draws success against the length of T-Mazes, from rows of ``benchmarks.memory_tasks``:
a line through each network's means, and a mark for each seed.

``curves`` draws success while training from its runs, a panel for each task and a line for each
network: the interquartile mean over the seeds of the share of successes in the last 100 or more
training episodes, and its 95% bootstrap interval. A run that ended because it had solved the task
keeps its last value.
"""

from __future__ import annotations

import argparse
import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from recipes.core.metrics import parse_metrics
from recipes.tools.results.experiments import find_runs
from recipes.tools.results.interval import intervals_of
from recipes.tools.results.plot import new_figure, save_figure

from .measuring import read_rows
from .memory_tasks import shares

_T_MAZE = re.compile(r"ppo/tmaze-(\d+)/(.+)")
_POINTS = 300


def plot_lengths(path: Path) -> Figure:
    """Draws success against length, the networks side by side.

    Raises:
        ValueError: if no row is of a T-Maze.
    """
    successes: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in read_rows(path):
        if match := _T_MAZE.fullmatch(row["recipe"]):
            successes[match[2]][int(match[1])].append(float(row["success"]))
    if not successes:
        raise ValueError(f"{path} has no run on a T-Maze")
    figure = new_figure((6.5, 4))
    axes = figure.subplots()
    axes.axhline(0.5, ls=":", c="gray", label="a guess at the junction")
    for index, (network, found) in enumerate(sorted(successes.items())):
        beside = 1.08 ** (index - (len(successes) - 1) / 2)
        style: dict[str, Any] = {"c": f"C{index}", "marker": "osD^v"[index % 5], "ms": 5}
        means = [fmean(found[length]) for length in sorted(found)]
        places = [length * beside for length in sorted(found)]
        axes.plot(places, means, **style, markevery=[], label=network)
        for length in sorted(found):
            axes.plot([length * beside] * len(found[length]), found[length], **style, ls="")
    lengths = sorted({length for found in successes.values() for length in found})
    axes.set_xscale("log")
    axes.set_xticks(lengths, map(str, lengths))
    axes.minorticks_off()
    axes.set(xlabel="length of the corridor", ylabel="success", ylim=(-0.03, 1.03))
    axes.legend(frameon=False)
    return figure


def plot_curves(folders: Sequence[Path]) -> Figure:
    """Draws success while training, the tasks side by side, with one color for each network.

    Raises:
        ValueError: if a run has fewer than a hundred episodes.
    """
    curves: dict[str, dict[str, list[np.ndarray]]] = defaultdict(lambda: defaultdict(list))
    for run in find_runs(folders):
        task, _, network = run.recipe.name.rpartition("/")
        # A table of runs has the successes beside the metrics.
        content = run.read("successes.csv") or run.read("metrics.csv")
        rows = parse_metrics(content, run.folder / "successes.csv")
        batches = [(int(row["step"]), int(row["episodes"]), int(row["successes"])) for row in rows]
        points = np.array(list(shares(batches)))
        if not len(points):
            raise ValueError(f"{run.folder} has fewer than a hundred episodes: train it for longer")
        curves[task][network].append(points.T)
    networks = sorted({network for group in curves.values() for network in group})
    figure = new_figure((0.8 + 4.2 * len(curves), 4))
    panels = figure.subplots(1, len(curves), squeeze=False, sharey=True)[0]
    for axes, (task, group) in zip(panels, sorted(curves.items()), strict=True):
        last = max(steps[-1] for runs in group.values() for steps, _ in runs)
        for network, runs in sorted(group.items()):
            grid = np.linspace(max(steps[0] for steps, _ in runs), last, _POINTS)
            # After its last batch, np.interp keeps a run's last value.
            mean, low, high = intervals_of(np.stack([np.interp(grid, *run) for run in runs]))
            color = f"C{networks.index(network)}"
            axes.plot(grid / 1000, mean, c=color, label=f"{network} ({len(runs)})")
            axes.fill_between(grid / 1000, low, high, color=color, alpha=0.2, lw=0)
        axes.set(title=task.rpartition("/")[2], xlabel="environment steps, thousands")
        axes.set_ylim(0, 1.03)
        axes.grid(alpha=0.3)
        axes.legend(title="network (seeds)", frameon=False, loc="lower right")
    panels[0].set_ylabel("success of training episodes")
    return figure


def main(arguments: list[str] | None = None) -> None:
    """Reads runs and writes a picture."""
    parser = argparse.ArgumentParser("python -m benchmarks.memory_pictures")
    parser.add_argument("what", choices=["lengths", "curves"])
    parser.add_argument("runs", type=Path, nargs="+", help="RUNS.CSV, or run folders")
    parser.add_argument("--out", type=Path, required=True, help="PNG file to write")
    options = parser.parse_args(arguments)
    try:
        runs = options.runs
        figure = plot_lengths(runs[0]) if options.what == "lengths" else plot_curves(runs)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    save_figure(figure, options.out)


if __name__ == "__main__":
    main()
