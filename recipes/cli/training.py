"""A run from start to end: training, evaluation, learning curve."""

from __future__ import annotations

import shlex
import sys
import time
from pathlib import Path

from torchrl_tit.settings.imports import import_options

from .. import runner
from ..algorithm import make_algorithm
from ..chosen_frames import with_chosen_frames
from ..initial_weights import weights_from
from ..recipe import Recipe
from ..results.plot import plot_run
from ..run import Run
from .arguments import override, program
from .evaluate import one_line


def start(recipe: Recipe, folder: Path | None, init_from: Path | None = None) -> None:
    """Starts a run; writes nothing if its recipe cannot be run.

    Args:
        recipe: the recipe.
        folder: the run folder to make; runs/NAME/seed-SEED-DATE if None.
        init_from: the run whose weights to start from, if any.
    """
    algorithm = make_algorithm(recipe)
    algorithm.check()
    weights = None
    if init_from is not None:
        weights, report = weights_from(init_from, algorithm)
        print(report)
    recipe, chosen = with_chosen_frames(recipe, algorithm)
    if chosen:
        print(f"frames chosen by kind of observation: {chosen}")
    _finish(Run.create(folder or _make_folder(recipe), recipe, weights))


def resume(folder: Path, device: str | None = None, threads: int | None = None) -> None:
    """Resumes a run.

    Args:
        folder: the run folder.
        device: the device to use; the recipe's if None.
        threads: the number of PyTorch's threads; the recipe's if None.
    """
    run = Run.open(folder)
    run.recipe = override(run.recipe, device=device, threads=threads)
    if changes := run.version_changes():
        print(f"note: versions changed since the start: {'; '.join(changes)}", file=sys.stderr)
    _finish(run)


def _finish(run: Run) -> None:
    """Finishes a run: trains, evaluates and plots what is left."""
    recipe, folder = run.recipe, run.folder
    with run:
        if run.is_complete():
            print(f"{folder} is complete: trained for {recipe.final_step} steps and evaluated")
            return
        try:
            runner.train(recipe, run)
            evaluation = runner.evaluate(run)
        except KeyboardInterrupt:
            words = [*program().split(), "train", "--resume", str(folder), *import_options()]
            print(f"stopped; to resume: {shlex.join(words)}", file=sys.stderr)
            raise
        run.save_evaluation(evaluation)
        plot_run(run)
    print(one_line(recipe, evaluation))
    print(f"run folder: {folder}\nlearning curve: {run.curve}")


def _make_folder(recipe: Recipe) -> Path:
    """Creates a folder at once, so that runs started in the same second get different ones."""
    name = recipe.name or recipe.algorithm
    base = Path("runs", name, f"seed-{recipe.seed}-{time.strftime('%Y%m%d-%H%M%S')}")
    base.parent.mkdir(parents=True, exist_ok=True)
    folder, number = base, 1
    while True:
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            number += 1
            folder = base.with_name(f"{base.name}-{number}")
