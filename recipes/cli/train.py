"""`train`: new runs, and runs to go on with."""

from __future__ import annotations

import shlex
import sys
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from ..offline.side_by_side import check_side_by_side, common_step
from ..recipe import Recipe
from ..registry import find_recipe
from ..run import Run
from .words import (
    USAGE,
    Parser,
    add_machine_options,
    fail,
    override,
    parse_fields,
    program,
    summary,
)


def train(words: list[str]) -> None:
    """Trains and evaluates new runs, or runs that were stopped."""
    runs = _resume(words) if words and words[0].startswith("--resume") else _start(words)
    recipe = runs[0].recipe
    with ExitStack() as stack:
        for run in runs:
            stack.enter_context(run)
        if all(run.is_complete() for run in runs):
            for run in runs:
                print(f"{run.folder} is complete: trained for {recipe.final_step} steps, evaluated")
            return
        try:
            if len(runs) == 1:
                recipe.train(runs[0])
            else:
                recipe.train_side_by_side(runs)
            evaluations = [run.recipe.evaluate(run) for run in runs]
        except KeyboardInterrupt:
            folders = shlex.join(str(run.folder) for run in runs)
            print(f"stopped; go on: {program()} train --resume {folders}", file=sys.stderr)
            raise
        for run, evaluation in zip(runs, evaluations, strict=True):
            run.save_evaluation(evaluation)
            curve = run.plot()
            print(summary(run.recipe, evaluation))
            print(f"run folder: {run.folder}\nlearning curve: {curve}")


def _start(words: list[str]) -> list[Run]:
    """New runs, one a seed; nothing is written where their recipe cannot be run."""
    if words and words[0] in ("-h", "--help"):
        print(USAGE.format(program=program()))
        sys.exit(0)
    if not words or words[0].startswith("-"):
        fail("train needs a recipe's name first, or --resume RUN")
    recipe, seeds, out = _parse(find_recipe(words[0]), words[1:])
    recipes = [replace(recipe, seed=seed) for seed in seeds] or [recipe]
    check_side_by_side(recipes)
    recipe.check()
    if out is None:
        folders = [_default_folder(recipe) for recipe in recipes]
    else:
        folders = [out / f"seed-{seed}" for seed in seeds] or [out]
    for folder in folders:
        Run.check_new(folder)
    return [Run.create(*pair) for pair in zip(folders, recipes, strict=True)]


def _resume(words: list[str]) -> list[Run]:
    parser = Parser(f"{program()} train")
    parser.add_argument(
        "--resume", type=Path, nargs="+", required=True, help="run folders to go on with"
    )
    add_machine_options(parser)
    options = parser.parse_args(words)
    runs = [Run.open(folder) for folder in options.resume]
    for run in runs:
        run.recipe = override(run.recipe, device=options.device, threads=options.threads)
        if changes := run.version_changes():
            print(f"note: other versions than at the start: {'; '.join(changes)}", file=sys.stderr)
    check_side_by_side([run.recipe for run in runs])
    common_step(runs)
    return runs


def _parse(recipe: Recipe, words: list[str]) -> tuple[Recipe, tuple[int, ...], Path | None]:
    """Overrides a recipe's fields, its network's included, and reads --seeds and --out."""
    seeds = tyro.conf.arg(
        help="Seeds to train side by side instead of --seed, in one gradient step of all (cql)."
    )
    out = tyro.conf.arg(
        help="Run folder to make, or with --seeds the folder of a seed-SEED for each; "
        "runs/NAME/seed-SEED-DATE where missing."
    )
    parsed = parse_fields(
        [
            ("recipe", Annotated[type(recipe), tyro.conf.arg(name="")], recipe),
            ("seeds", Annotated[tuple[int, ...], seeds], ()),
            ("out", Annotated[Path | None, out], None),
        ],
        words,
        f"train {recipe.name}",
        type(recipe).__doc__,
    )
    return parsed.recipe, parsed.seeds, parsed.out


def _default_folder(recipe: Recipe) -> Path:
    """A new folder, made at once: runs that start in the same second get one each."""
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
