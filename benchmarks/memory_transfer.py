"""Agents of MiniGrid-Memory in other mazes, as they are: ``python -m benchmarks.memory_transfer``.

Each run plays each maze with the most likely actions. An episode is successful if it returns more
than 0. There is a row for each run and maze; those that the file has already are not repeated.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from statistics import fmean

from recipes.core import runner
from recipes.core.run import Run

from .measuring import add_missing_rows

MAZES = ("S7", "S9", "S11", "S13", "S13Random", "S17Random")
COLUMNS = ["recipe", "seed", "maze", "episodes", "success", "return"]


def main(arguments: list[str] | None = None) -> None:
    """Plays all runs in all mazes that have no row yet."""
    parser = argparse.ArgumentParser("python -m benchmarks.memory_transfer")
    parser.add_argument("runs", nargs="+", type=Path, help="run folders")
    parser.add_argument("--mazes", nargs="+", default=MAZES)
    parser.add_argument("--episodes", type=int, default=200)
    parser.add_argument("--out", type=Path, required=True, help="CSV")
    options = parser.parse_args(arguments)
    try:
        found = [Run.open(folder) for folder in options.runs]
    except (ValueError, OSError) as error:
        parser.error(" ".join(str(error).split()))
    runs = {(run.recipe.name, run.recipe.seed): run for run in found}

    def play(name: str, seed: int, maze: str) -> list[object]:
        run = runs[name, seed]
        env = f"MiniGrid-Memory{maze}-v0"
        there = replace(run.recipe, env=env, evaluation_episodes=options.episodes)
        evaluation = runner.evaluate(run, there)
        success = fmean(value > 0 for value in evaluation["returns"])
        return [name, seed, maze, options.episodes, success, round(evaluation["mean"], 4)]

    rows = [(name, seed, maze) for name, seed in runs for maze in options.mazes]
    add_missing_rows(options.out, COLUMNS, rows, play)


if __name__ == "__main__":
    main()
