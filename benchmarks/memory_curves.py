"""Success while training: ``python -m benchmarks.memory_curves RUN ... --out PNG``.

Draws the runs of ``benchmarks.memory_tasks``, a panel for each task and a line for each network:
the interquartile mean over the seeds of the share of successes in the last 100 or more training
episodes, and its 95 % bootstrap interval. A run that ended because it had solved the task keeps its
last value.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from recipes.metrics import parse_metrics
from recipes.results.experiments import find_runs
from recipes.results.interval import intervals_of
from recipes.results.plot import new_figure, save_figure

from .memory_tasks import shares

_POINTS = 300
_Curve = tuple[np.ndarray, np.ndarray]  # steps and shares
_Curves = dict[str, dict[str, list[_Curve]]]


def read_curves(folders: Sequence[Path]) -> _Curves:
    """Returns the curves of all seeds, by task and network."""
    found: _Curves = defaultdict(lambda: defaultdict(list))
    for run in find_runs(folders):
        task, _, network = run.recipe.name.rpartition("/")
        # A table of runs has the successes beside the metrics.
        content = run.read("successes.csv") or run.read("metrics.csv")
        rows = parse_metrics(content, run.folder / "successes.csv")
        batches = [(row["step"], row["episodes"], row["successes"]) for row in rows]
        points = np.array(list(shares((int(a), int(b), int(c)) for a, b, c in batches)))
        if not len(points):
            raise ValueError(f"{run.folder} has fewer than a hundred episodes: train it for longer")
        found[task][network].append((points[:, 0], points[:, 1]))
    return found


def plot_curves(curves: _Curves) -> Figure:
    """Draws the curves, the tasks side by side, with the same color for a network everywhere."""
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
    """Reads the runs and writes the picture."""
    parser = argparse.ArgumentParser("python -m benchmarks.memory_curves")
    parser.add_argument(
        "runs", type=Path, nargs="+", metavar="RUN", help="runs of benchmarks.memory_tasks"
    )
    parser.add_argument("--out", type=Path, required=True, help="PNG file to write")
    options = parser.parse_args(arguments)
    try:
        curves = read_curves(options.runs)
    except (OSError, ValueError) as error:
        parser.error(str(error))
    save_figure(plot_curves(curves), options.out)


if __name__ == "__main__":
    main()
