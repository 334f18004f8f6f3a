"""What is done with finished runs: `evaluate`, `render`, `compare`, `table`."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from torchrl_tit.files import write_text_atomic

from ..recipe import Recipe
from ..results.plot import plot_comparison, plot_table
from ..results.table import make_table, to_csv, to_markdown
from ..run import Run
from .words import Parser, add_machine_options, fail, override, program, summary


def evaluate(words: list[str]) -> None:
    """Evaluates the newest checkpoint of a run."""
    parser = Parser(f"{program()} evaluate")
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--episodes", type=int, help="episodes; the recipe's if missing")
    parser.add_argument(
        "--seed", type=int, help="seed of the first episode; the recipe's if missing"
    )
    parser.add_argument("--out", type=Path, help="file to write; RUN/evaluation.json if missing")
    add_machine_options(parser)
    options = parser.parse_args(words)
    run = Run.open(options.run)
    recipe = override(
        run.recipe,
        evaluation_episodes=options.episodes,
        evaluation_seed=options.seed,
        device=options.device,
        threads=options.threads,
    )
    if options.out is not None and not options.out.absolute().parent.is_dir():
        fail(f"--out {options.out} cannot be written: there is no folder {options.out.parent}")
    evaluation = recipe.evaluate(run)
    path = run.save_evaluation(evaluation, options.out)
    print(f"{summary(recipe, evaluation)}\nwritten to {path}")


def render(words: list[str]) -> None:
    """Films the agent of a run."""
    from ..results.film import film  # not at the top: only films need what it imports.

    parser = Parser(f"{program()} render")
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--out", type=Path, required=True, help="new file: .gif or .mp4")
    parser.add_argument("--episodes", type=int, default=1, help="episodes, or whole Atari games")
    parser.add_argument(
        "--seed", type=int, help="seed of the first episode; the evaluation's if missing"
    )
    options = parser.parse_args(words)
    run = Run.open(options.run)
    recipe = override(run.recipe, evaluation_seed=options.seed)
    returns = film(recipe, run, options.out, options.episodes)
    print(f"returns {', '.join(f'{value:g}' for value in returns)}\nwritten to {options.out}")


def compare(words: list[str]) -> None:
    """Draws learning curves of several runs."""
    parser = Parser(f"{program()} compare")
    parser.add_argument("runs", type=Path, nargs="+", help="run folders")
    parser.add_argument("--out", type=Path, default=Path("comparison.png"), help="PNG to write")
    parser.add_argument("--title", default="", help="title of the picture")
    options = parser.parse_args(words)
    if options.out.suffix != ".png":
        fail(f"--out {options.out} must end in .png: what is written is a PNG")
    seeds: dict[Recipe, list[Path]] = {}  # runs of the same settings
    for folder in dict.fromkeys(options.runs):
        seeds.setdefault(replace(Run.open(folder).recipe, seed=0), []).append(folder)
    offline = {recipe.offline for recipe in seeds}
    if len(offline) > 1:
        fail("environment steps and gradient steps have no axis in common: compare them apart")
    names = [recipe.name for recipe in seeds]
    curves = {}
    for recipe, folders in seeds.items():
        name = recipe.name
        if not name or names.count(name) > 1:
            name = f"{name} {folders[0]}".lstrip()
        curves[name] = [folder / "metrics.csv" for folder in folders]
    plot_comparison(curves, options.out, title=options.title, offline=offline.pop())
    print(f"written to {options.out}")


def table(words: list[str]) -> None:
    """Prints the paper's tables with the runs in folders."""
    parser = Parser(f"{program()} table")
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
