"""The command line."""

from __future__ import annotations

import argparse
import io
import shlex
import sys
import time
from contextlib import ExitStack, redirect_stderr
from dataclasses import make_dataclass, replace
from fnmatch import fnmatchcase
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, NoReturn

import tyro

from torchrl_tit.files import write_text_atomic

from .offline.side_by_side import check_side_by_side, common_step
from .recipe import Recipe, recipe_to_json
from .registry import RECIPES, find_recipe
from .results.plot import plot_comparison, plot_table
from .results.table import make_table, to_csv, to_markdown
from .run import Run
from .sweeps.sweep import make_jobs, run_jobs

_USAGE = """\
usage: {program} COMMAND ...

  list [PATTERN]              the named recipes, those that contain PATTERN
  show NAME                   a recipe's settings as JSON
  train NAME [--FIELD VALUE]  train a named recipe, or one in a JSON file;
                              `train NAME --help` explains every field
  train NAME --seeds 0 1 2    train several seeds side by side, in one gradient step (cql)
  train --resume RUN [RUN]    go on with runs that were stopped or killed; several side by side
  evaluate RUN                evaluate a run's newest checkpoint
  render RUN --out FILE       film a run's agent: a GIF or MP4
  sweep NAME [NAME ...]       train many recipes and seeds side by side; names can be patterns
  tune NAME --out FOLDER      search a recipe's fields for the best settings, with Optuna
  compare RUN [RUN ...]       learning curves of several runs, seeds of a recipe as one band
  table FOLDER [FOLDER ...]   the paper's tables from all runs in folders
  data info SOURCE            what is in a data set: an HDF5 file, D4RL's or Minari's name
  data convert SOURCE TARGET  between HDF5 in D4RL's layout and Minari
  data collect TASK           medium, mixed, expert and random sets of a task, as D4RL made them

Everywhere: --seed, --out, --device, --threads where they apply; COMMAND --help tells.
"""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line.

    Args:
        arguments: the words after the program's name; those of this process where None.
    """
    words = sys.argv[1:] if arguments is None else arguments
    commands = {
        "list": _list,
        "show": _show,
        "train": _train,
        "evaluate": _evaluate,
        "render": _render,
        "sweep": _sweep,
        "tune": _tune,
        "compare": _compare,
        "table": _table,
        "data": _data,
    }
    if not words or words[0] not in commands:
        asked = not words or words[0] in ("-h", "--help")
        print(_USAGE.format(program=_program()), file=sys.stdout if asked else sys.stderr)
        if not asked:
            _fail(f"unknown command {words[0]!r}: choose from {', '.join(commands)}")
        return
    try:
        commands[words[0]](words[1:])
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # `list | head`: nobody reads on
        sys.stdout = None
    except (ValueError, OSError, RuntimeError, FloatingPointError) as error:
        _fail(str(error))


def _list(words: list[str]) -> None:
    parser = _Parser(f"{_program()} list")
    parser.add_argument("pattern", nargs="?", default="", help="part of a name; * is any text")
    pattern = parser.parse_args(words).pattern
    names = [name for name in RECIPES if fnmatchcase(name, f"*{pattern}*")]
    if not names:
        _fail(f"no recipe contains {pattern!r}: `{_program()} list` names all of them")
    print("\n".join(names))


def _show(words: list[str]) -> None:
    parser = _Parser(f"{_program()} show")
    parser.add_argument("name", help="name of a recipe, or a JSON file")
    print(recipe_to_json(find_recipe(parser.parse_args(words).name)), end="")


def _train(words: list[str]) -> None:
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
            print(f"stopped; go on: {_program()} train --resume {folders}", file=sys.stderr)
            raise
        for run, evaluation in zip(runs, evaluations, strict=True):
            run.save_evaluation(evaluation)
            curve = run.plot()
            print(_summary(run.recipe, evaluation))
            print(f"run folder: {run.folder}\nlearning curve: {curve}")


def _start(words: list[str]) -> list[Run]:
    """New runs, one a seed; nothing is written where their recipe cannot be run."""
    if words and words[0] in ("-h", "--help"):
        print(_USAGE.format(program=_program()))
        sys.exit(0)
    if not words or words[0].startswith("-"):
        _fail("train needs a recipe's name first, or --resume RUN")
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
    parser = _Parser(f"{_program()} train")
    parser.add_argument(
        "--resume", type=Path, nargs="+", required=True, help="run folders to go on with"
    )
    _add_machine_options(parser)
    options = parser.parse_args(words)
    runs = [Run.open(folder) for folder in options.resume]
    for run in runs:
        run.recipe = _override(run.recipe, device=options.device, threads=options.threads)
        if changes := run.version_changes():
            print(f"note: other versions than at the start: {'; '.join(changes)}", file=sys.stderr)
    check_side_by_side([run.recipe for run in runs])
    common_step(runs)
    return runs


def _summary(recipe: Recipe, evaluation: dict[str, Any]) -> str:
    return (
        f"{recipe.name}: return {evaluation['mean']:.1f} ± {evaluation['std']:.1f} over "
        f"{evaluation['episodes']} episodes after {evaluation['steps']} steps"
    )


def _parse(recipe: Recipe, words: list[str]) -> tuple[Recipe, tuple[int, ...], Path | None]:
    """Overrides a recipe's fields, its network's included, and reads --seeds and --out."""
    seeds = tyro.conf.arg(
        help="Seeds to train side by side instead of --seed, in one gradient step of all (cql)."
    )
    out = tyro.conf.arg(
        help="Run folder to make, or with --seeds the folder of a seed-SEED for each; "
        "runs/NAME/seed-SEED-DATE where missing."
    )
    parsed = _parse_fields(
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


def _parse_fields(
    fields: list[Any], words: list[str], command: str, description: str | None
) -> Any:
    """Reads dataclasses from the command line: fields as `make_dataclass` takes them."""
    settings = make_dataclass("settings", fields)
    errors = io.StringIO()
    try:
        with redirect_stderr(errors):
            return tyro.cli(
                tyro.conf.AvoidSubcommands[settings],  # type: ignore[misc, valid-type]
                args=words,
                prog=f"{_program()} {command}",
                description=description,
            )
    except SystemExit as stop:
        if stop.code:
            _fail(_unboxed(errors.getvalue()))
        raise


def _unboxed(message: str) -> str:
    """What tyro says in a box, as a sentence: the reason, and the options that are like it."""
    lines = [line.strip("│ ") for line in message.splitlines()]
    reason = " ".join(takewhile(lambda line: line[:1] not in "─╰", lines[1:]))
    similar = [line.split()[0] for line in lines if line.startswith("--") and line != "--help"]
    hint = f"; did you mean {' or '.join(similar)}?" if "Perhaps you meant" in message else ""
    return (reason or message) + hint


def _evaluate(words: list[str]) -> None:
    parser = _Parser(f"{_program()} evaluate")
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--episodes", type=int, help="episodes; the recipe's if missing")
    parser.add_argument(
        "--seed", type=int, help="seed of the first episode; the recipe's if missing"
    )
    parser.add_argument("--out", type=Path, help="file to write; RUN/evaluation.json if missing")
    _add_machine_options(parser)
    options = parser.parse_args(words)
    run = Run.open(options.run)
    recipe = _override(
        run.recipe,
        evaluation_episodes=options.episodes,
        evaluation_seed=options.seed,
        device=options.device,
        threads=options.threads,
    )
    if options.out is not None and not options.out.absolute().parent.is_dir():
        _fail(f"--out {options.out} cannot be written: there is no folder {options.out.parent}")
    evaluation = recipe.evaluate(run)
    path = run.save_evaluation(evaluation, options.out)
    print(f"{_summary(recipe, evaluation)}\nwritten to {path}")


def _render(words: list[str]) -> None:
    # Not at the top: only pictures need what it imports.
    from .results.render import add_render_options, run_render

    parser = _Parser(f"{_program()} render")
    add_render_options(parser)
    run_render(parser.parse_args(words))


def _sweep(words: list[str]) -> None:
    parser = _Parser(f"{_program()} sweep")
    parser.add_argument(
        "names", nargs="+", help="names of recipes, or patterns such as 'ppo/*/mlp'"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="seeds of each recipe")
    parser.add_argument(
        "--workers", type=int, help="runs at a time, a process each: 1, on Ray what fits"
    )
    parser.add_argument(
        "--ray", metavar="ADDRESS", help="run on a Ray cluster: auto, HOST:PORT or ray://HOST:PORT"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/sweep"), help="folder of the runs")
    options = parser.parse_args(words)
    if options.workers is not None and options.workers < 1:
        _fail(f"--workers must be at least 1, not {options.workers}")
    jobs = make_jobs(options.names, options.seeds, options.out)
    try:
        if options.ray is None:
            failed = run_jobs(jobs, options.workers or 1)
        else:
            # Not at the top: Ray is an extra.
            from .sweeps.sweep_ray import RayWorker, connect, count_begun, find_unmet_needs

            connect(options.ray)
            for note in find_unmet_needs(jobs):
                print(f"note: {note}", file=sys.stderr)
            failed = run_jobs(jobs, options.workers or len(jobs), RayWorker, count_begun)
    except KeyboardInterrupt:
        print("stopped; the same command goes on", file=sys.stderr)
        raise
    if failed:
        _fail(
            f"{len(failed)} of {len(jobs)} runs failed, see {', '.join(str(j.log) for j in failed)}"
        )
    print(f"{len(jobs)} runs are complete in {options.out}")


def _tune(words: list[str]) -> None:
    # Not at the top: Optuna is an extra.
    from .sweeps.search_space import load_space
    from .sweeps.tune import Search, Settings

    parser = _Parser(f"{_program()} tune")
    parser.add_argument("name", help="name of a recipe, or a JSON file")
    parser.add_argument("--space", type=Path, help="JSON file with the search space")
    parser.add_argument("--trials", type=int, default=50, help="trials of the whole search")
    parser.add_argument("--workers", type=int, default=1, help="trials at a time, a process each")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="seeds of each trial")
    parser.add_argument(
        "--startup-trials", type=int, default=5, help="trials before which none is pruned"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the search")
    options = parser.parse_args(words)
    for name in ("trials", "workers", "startup_trials"):
        if getattr(options, name) < 1:
            _fail(f"--{name.replace('_', '-')} must be at least 1, not {getattr(options, name)}")
    recipe = find_recipe(options.name)
    recipe.check()
    settings = Settings(
        recipe,
        load_space(options.space, recipe),
        seeds=tuple(options.seeds),
        startup_trials=options.startup_trials,
    )
    search = Search(options.out, settings)
    try:
        failed = search.run(options.trials, options.workers)
    except KeyboardInterrupt:
        print("stopped; the same command goes on", file=sys.stderr)
        raise
    best = search.best()
    if failed:
        print(f"note: trials {failed} failed: see trial-N/*.log in {options.out}", file=sys.stderr)
    if best is None:
        _fail(f"no trial of {options.out} was complete")
    values = ", ".join(f"{field} {value}" for field, value in best.params.items())
    print(f"best of {len(search.study.trials)} trials: {best.value:.1f} with {values}")
    print(f"its recipe: {options.out / 'best.json'}")


def _compare(words: list[str]) -> None:
    parser = _Parser(f"{_program()} compare")
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    parser.add_argument("--out", type=Path, default=Path("comparison.png"), help="PNG to write")
    parser.add_argument("--title", default="", help="title of the picture")
    options = parser.parse_args(words)
    curves: dict[str, list[Path]] = {}
    for folder in options.runs:
        run = Run.open(folder)
        curves.setdefault(run.recipe.name or str(folder), []).append(folder / "metrics.csv")
    plot_comparison(curves, options.out, title=options.title, offline=run.recipe.offline)
    print(f"written to {options.out}")


def _table(words: list[str]) -> None:
    parser = _Parser(f"{_program()} table")
    parser.add_argument("folders", type=Path, nargs="+", help="folders with run folders in them")
    parser.add_argument("--format", choices=["md", "csv"], default="md", help="what is printed")
    parser.add_argument("--out", type=Path, help="folder for table.md, table.csv and table.png")
    options = parser.parse_args(words)
    cells, notes = make_table(options.folders)
    for note in notes:
        print(f"note: {note}", file=sys.stderr)
    print(to_csv(cells) if options.format == "csv" else to_markdown(cells), end="")
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        write_text_atomic(options.out / "table.md", to_markdown(cells))
        write_text_atomic(options.out / "table.csv", to_csv(cells))
        plot_table(cells, options.out / "table.png")
        print(f"written to {options.out}")


def _collect(words: list[str]) -> None:
    from .collect import Collection, collect  # takes a second that others save

    out = tyro.conf.arg(help="Folder of the data, which the same command goes on with.")
    parsed = _parse_fields(
        [
            ("collection", Annotated[Collection, tyro.conf.arg(name="")]),
            ("out", Annotated[Path, out]),
        ],
        words,
        "data collect",
        Collection.__doc__,
    )
    command = shlex.join([*_program().split(), "data", "collect", *words])
    try:
        lines = collect(parsed.collection, parsed.out, command)
    except KeyboardInterrupt:
        print("stopped; the same command goes on", file=sys.stderr)
        raise
    print("\n".join(lines))


def _data(words: list[str]) -> None:
    if words[:1] == ["collect"]:
        return _collect(words[1:])
    from .data import add_data_commands, run_data_command  # takes a second that others save

    parser = _Parser(f"{_program()} data")
    add_data_commands(parser)
    print(run_data_command(parser.parse_args(words)))


def _add_machine_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--device", choices=["cpu", "cuda", "auto"], help="the recipe's if missing")
    parser.add_argument("--threads", type=int, help="the recipe's if missing")


def _override(recipe: Recipe, **fields: Any) -> Recipe:
    return replace(recipe, **{key: value for key, value in fields.items() if value is not None})


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


def _program() -> str:
    name = Path(sys.argv[0]).name
    return "python -m recipes" if name == "__main__.py" else name


class _Parser(argparse.ArgumentParser):
    """A parser that reports errors as the other parts of the command line do."""

    def error(self, message: str) -> NoReturn:
        _fail(f"{message} (`{self.prog} --help` tells more)")


def _fail(message: str) -> NoReturn:
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(2)
