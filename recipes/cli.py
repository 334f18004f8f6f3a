"""The command line: list, show, train, evaluate."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import make_dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchrl_tit.checkpoint import CheckpointError

from .recipe import Recipe, recipe_from_json, recipe_to_json
from .registry import RECIPES, get_recipe
from .run import Run

_USAGE = """\
usage: {program} COMMAND ...

  list [PATTERN]              the named recipes, those that contain PATTERN
  show NAME                   a recipe's settings as JSON
  train NAME [--FIELD VALUE]  train a named recipe, or one in a JSON file;
                              `train NAME --help` explains every field
  train --resume RUN          go on with a run that was stopped or killed
  evaluate RUN                evaluate a run's newest checkpoint

Everywhere: --seed, --out, --device, --threads where they apply; COMMAND --help tells.
"""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line.

    Args:
        arguments: the words after the program's name; those of this process where None.
    """
    words = sys.argv[1:] if arguments is None else arguments
    commands = {"list": _list, "show": _show, "train": _train, "evaluate": _evaluate}
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
    except (ValueError, OSError, RuntimeError, FloatingPointError, CheckpointError) as error:
        _fail(str(error))


def _list(words: list[str]) -> None:
    parser = argparse.ArgumentParser(f"{_program()} list")
    parser.add_argument("pattern", nargs="?", default="", help="part of a name")
    pattern = parser.parse_args(words).pattern
    names = [name for name in RECIPES if pattern in name]
    if not names:
        _fail(f"no recipe contains {pattern!r}: `{_program()} list` names all of them")
    print("\n".join(names))


def _show(words: list[str]) -> None:
    parser = argparse.ArgumentParser(f"{_program()} show")
    parser.add_argument("name", help="name of a recipe, or a JSON file")
    print(recipe_to_json(_find(parser.parse_args(words).name)), end="")


def _train(words: list[str]) -> None:
    if words and words[0] == "--resume":
        parser = argparse.ArgumentParser(f"{_program()} train")
        parser.add_argument("--resume", type=Path, required=True, help="run folder to go on with")
        run = Run.open(parser.parse_args(words).resume)
        if changes := run.version_changes():
            print(f"note: other versions than at the start: {'; '.join(changes)}", file=sys.stderr)
    else:
        if not words or words[0].startswith("-"):
            print(_USAGE.format(program=_program()), file=sys.stderr)
            _fail("train needs a recipe's name, or --resume RUN")
        recipe, out = _parse(_find(words[0]), words[1:])
        run = Run.create(out or _default_folder(recipe), recipe)
    with run:
        run.recipe.train(run)
        evaluation = run.recipe.evaluate(run)
        run.save_evaluation(evaluation)
        curve = run.plot()
    print(_summary(run.recipe, evaluation))
    print(f"run folder: {run.folder}\nlearning curve: {curve}")


def _summary(recipe: Recipe, evaluation: dict[str, Any]) -> str:
    return (
        f"{recipe.name}: return {evaluation['mean']:.1f} ± {evaluation['std']:.1f} over "
        f"{evaluation['episodes']} episodes after {evaluation['steps']} steps"
    )


def _parse(recipe: Recipe, words: list[str]) -> tuple[Recipe, Path | None]:
    """Overrides a recipe's fields, its network's included, and reads --out."""
    out = tyro.conf.arg(help="Run folder to make; runs/NAME/seed-SEED-DATE where missing.")
    settings = make_dataclass(
        "settings",
        [
            ("recipe", Annotated[type(recipe), tyro.conf.arg(name="")], recipe),
            ("out", Annotated[Path | None, out], None),
        ],
    )
    parsed: Any = tyro.cli(
        tyro.conf.AvoidSubcommands[settings],  # type: ignore[misc, valid-type]
        args=words,
        prog=f"{_program()} train {recipe.name}",
        description=type(recipe).__doc__,
    )
    return parsed.recipe, parsed.out


def _evaluate(words: list[str]) -> None:
    parser = argparse.ArgumentParser(f"{_program()} evaluate")
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--episodes", type=int, help="episodes; the recipe's if missing")
    parser.add_argument(
        "--seed", type=int, help="seed of the first episode; the recipe's if missing"
    )
    parser.add_argument("--out", type=Path, help="file to write; RUN/evaluation.json if missing")
    parser.add_argument("--device", choices=["cpu", "cuda", "auto"], help="the recipe's if missing")
    parser.add_argument("--threads", type=int, help="the recipe's if missing")
    options = parser.parse_args(words)
    run = Run.open(options.run)
    overrides = {
        "evaluation_episodes": options.episodes,
        "evaluation_seed": options.seed,
        "device": options.device,
        "threads": options.threads,
    }
    given = {field: value for field, value in overrides.items() if value is not None}
    evaluation = replace(run.recipe, **given).evaluate(run)
    path = run.save_evaluation(evaluation, options.out)
    print(f"{_summary(run.recipe, evaluation)}\nwritten to {path}")


def _find(name: str) -> Recipe:
    """A recipe by name, or from a JSON file such as a run's recipe.json."""
    path = Path(name)
    if path.suffix == ".json":
        return recipe_from_json(path.read_text(), path)
    return get_recipe(name)


def _default_folder(recipe: Recipe) -> Path:
    name = recipe.name or recipe.algorithm
    return Path("runs", name, f"seed-{recipe.seed}-{time.strftime('%Y%m%d-%H%M%S')}")


def _program() -> str:
    name = Path(sys.argv[0]).name
    return "python -m recipes" if name == "__main__.py" else name


def _fail(message: str) -> None:
    print(f"error: {message}", file=sys.stderr)
    sys.exit(2)
