"""Success on tasks that need a past: ``python -m benchmarks.memory_tasks RECIPE ... --out FOLDER``.

Each recipe is trained with each seed in a run folder. A run that was stopped goes on when the
command is repeated. An episode is successful if it returns more than ``--threshold``, whose default
fits MiniGrid-Memory and the T-Maze.

Training ends early once 98% of the last 500 episodes were successful, and then 98% of as many
episodes as the recipe's evaluation has, with the most likely actions and seeds of their own. If
those fail, training goes on for at least 500 episodes. In the end, the final weights are evaluated.
With ``--init-from``, training starts with the weights of the runs of another, easier task. There is

- a row in ``runs.csv`` for each run; runs that have one are not repeated;
- ``successes.csv`` in each run's folder: episodes and successes of each batch.
"""

from __future__ import annotations

import argparse
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

from recipes.core import runner
from recipes.core.algorithm import make_algorithm
from recipes.core.callback import Callback
from recipes.core.initial_weights import weights_from
from recipes.core.recipe import Recipe
from recipes.core.registry import find_recipe
from recipes.core.run import Run
from torchrl_tit.checkpoint import checkpoint_steps
from torchrl_tit.evaluation import finished_returns
from torchrl_tit.files import write_text_atomic

from .measuring import add_missing_rows, read_rows

SOLVED, EPISODES = 0.98, 500
REACHED, WINDOW = 0.9, 100
"""``steps_to_0.9`` is where the share of successes first is this high over so many episodes."""
VALIDATION_SEED = 2_000_000
"""The seed of the first episode that decides whether training ends early."""
COLUMNS = ["recipe", "seed", "weights", "steps", "steps_to_0.9", "success", "return"]


Batch = tuple[int, int, int]
"""The step at the end of a batch, the episodes that ended in it, and their successes."""


def shares(batches: Iterable[Batch]) -> Iterator[tuple[int, float]]:
    """Yields steps with the share of successes in the last 100 or more episodes, once there are."""
    window: deque[tuple[int, int]] = deque()
    for step, episodes, right in batches:
        window.append((episodes, right))
        while sum(count for count, _ in window) - window[0][0] >= WINDOW:
            window.popleft()
        count, successes = map(sum, zip(*window, strict=True))
        if count >= WINDOW:
            yield step, successes / count


class Successes(Callback):
    """Counts successful episodes, and stops training when nearly all are.

    Args:
        path: CSV of the batches so far. Rows after the step are dropped: they are repeated.
        step: the step from which the run goes on.
        threshold: the return that a successful episode exceeds.
    """

    def __init__(self, path: Path, step: int, threshold: float) -> None:
        self.path = path
        self.threshold = threshold
        self.batches: list[Batch] = []
        self._last: deque[bool] = deque(maxlen=EPISODES)
        if step:
            for row in read_rows(path):
                if int(row["step"]) <= step:
                    self.add(*map(int, row.values()))

    def collected(self, step: int, batch: Any) -> None:
        """Counts the episodes that ended in a batch."""
        returns = finished_returns(batch)
        self.add(step, returns.numel(), int((returns > self.threshold).sum()))

    def updated(self, step: int, policy: Any) -> bool:
        """Returns whether nearly all of the last episodes were successful."""
        return len(self._last) == EPISODES and fmean(self._last) >= SOLVED

    def start_again(self) -> None:
        """Lets training go on until nearly all of as many further episodes are successful."""
        self._last.clear()

    def saving(self, step: int) -> None:
        """Writes the batches, before the checkpoint that they belong to."""
        rows = [["step", "episodes", "successes"], *self.batches]
        write_text_atomic(self.path, "".join(",".join(map(str, row)) + "\n" for row in rows))

    def reached(self) -> int | None:
        """Returns the first step with 90% of successes in the last 100 or more episodes."""
        return next((step for step, share in shares(self.batches) if share >= REACHED), None)

    def add(self, step: int, episodes: int, right: int) -> None:
        """Adds a batch: the step at its end, episodes that ended in it, and successes."""
        self.batches.append((step, episodes, right))
        # The order within a batch does not matter.
        self._last += [True] * right + [False] * (episodes - right)


def measure(
    recipe: Recipe, folder: Path, threshold: float, init_from: Path | None = None
) -> list[object]:
    """Trains and evaluates in a run folder, from its newest checkpoint; returns the row.

    A new run starts with the weights of ``init_from``, the folder of another run, if there is one.
    """

    def succeeded(evaluation: dict[str, Any]) -> float:
        return fmean(value > threshold for value in evaluation["returns"])

    if not (folder / "recipe.json").exists():
        weights = None if init_from is None else weights_from(init_from, make_algorithm(recipe))[0]
        Run.create(folder, recipe, weights)
    with Run.open(folder) as run:
        validation = replace(run.recipe, evaluation_seed=VALIDATION_SEED)
        step = max(checkpoint_steps(run.checkpoints), default=0)
        successes = Successes(folder / "successes.csv", step, threshold)
        while step < run.recipe.final_step:
            if successes.updated(step, None):
                if succeeded(runner.evaluate(run, validation)) >= SOLVED:
                    break
                successes.start_again()
            runner.train(run.recipe, run, [successes])
            step = max(checkpoint_steps(run.checkpoints))
        evaluation = runner.evaluate(run)
        run.save_evaluation(evaluation)
        _, algorithm, _ = runner.load_trained(run)
    weights = sum(weight.numel() for weight in algorithm.policy.parameters())
    reached = successes.reached()
    success, returned = succeeded(evaluation), round(evaluation["mean"], 4)
    return [recipe.name, recipe.seed, weights, step, reached, success, returned]


def main(arguments: list[str] | None = None) -> None:
    """Trains all recipes with all seeds that have no row yet."""
    parser = argparse.ArgumentParser("python -m benchmarks.memory_tasks")
    parser.add_argument(
        "recipes", nargs="+", metavar="RECIPE", help="names, or files with a recipe"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--threshold", type=float, default=0.0, help="successes return more")
    parser.add_argument(
        "--init-from",
        type=Path,
        metavar="FOLDER",
        help="runs of another task: each seed starts with the weights of FOLDER/seed-N",
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs and runs.csv")
    options = parser.parse_args(arguments)

    try:
        recipes = {recipe.name: recipe for recipe in map(find_recipe, options.recipes)}
    except (ImportError, ValueError, OSError) as error:
        parser.error(" ".join(str(error).split()))

    def measure_run(name: str, seed: int) -> list[object]:
        recipe = replace(recipes[name], seed=seed)
        start = options.init_from and options.init_from / f"seed-{seed}"
        return measure(recipe, options.out / name / f"seed-{seed}", options.threshold, start)

    runs = [(name, seed) for seed in options.seeds for name in recipes]
    add_missing_rows(options.out / "runs.csv", COLUMNS, runs, measure_run)


if __name__ == "__main__":
    main()
