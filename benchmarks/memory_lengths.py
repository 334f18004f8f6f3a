"""Success against how long ago the cue was: ``python -m benchmarks.memory_lengths RUNS.CSV``.

Draws the rows that ``benchmarks.memory_tasks`` wrote of runs on T-Mazes, as PNG.
"""

from __future__ import annotations

import argparse
import csv
import re
from collections import defaultdict
from pathlib import Path
from statistics import fmean
from typing import Any

from matplotlib.figure import Figure

from recipes.results.plot import new_figure, save_figure

_T_MAZE = re.compile(r"ppo/tmaze-(\d+)/(.+)")
_Successes = dict[str, dict[int, list[float]]]


def read_successes(path: Path) -> _Successes:
    """Returns the successes of all seeds, by network and length of the corridor."""
    found: _Successes = defaultdict(lambda: defaultdict(list))
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if match := _T_MAZE.fullmatch(row["recipe"]):
                found[match[2]][int(match[1])].append(float(row["success"]))
    return found


def plot_lengths(successes: _Successes) -> Figure:
    """Draws a line through each network's means, and a mark a seed, the networks side by side."""
    figure = new_figure((6.5, 4))
    axes = figure.subplots()
    axes.axhline(0.5, ls=":", c="grey", label="a guess at the junction")
    for index, (network, found) in enumerate(sorted(successes.items())):
        beside = 1.08 ** (index - (len(successes) - 1) / 2)
        places = [length * beside for length in sorted(found)]
        means = [fmean(found[length]) for length in sorted(found)]
        style: dict[str, Any] = {"c": f"C{index}", "marker": "osD^v"[index % 5], "ms": 5}
        axes.plot(places, means, **style, markevery=[], label=network)
        for place, length in zip(places, sorted(found), strict=True):
            axes.plot([place] * len(found[length]), found[length], **style, ls="")
    lengths = sorted({length for found in successes.values() for length in found})
    axes.set_xscale("log")
    axes.set_xticks(lengths, map(str, lengths))
    axes.minorticks_off()
    axes.set(xlabel="length of the corridor", ylabel="success", ylim=(-0.03, 1.03))
    axes.legend(frameon=False)
    return figure


def main(arguments: list[str] | None = None) -> None:
    """Reads the rows and writes the picture."""
    parser = argparse.ArgumentParser("python -m benchmarks.memory_lengths")
    parser.add_argument("runs", type=Path, metavar="RUNS.CSV", help="of benchmarks.memory_tasks")
    parser.add_argument("--out", type=Path, required=True, help="PNG file to write")
    options = parser.parse_args(arguments)
    successes = read_successes(options.runs)
    if not successes:
        parser.error(f"{options.runs} has no run on a T-Maze")
    save_figure(plot_lengths(successes), options.out)


if __name__ == "__main__":
    main()
