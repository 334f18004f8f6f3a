"""How commands read their words, and say what is wrong with them."""

from __future__ import annotations

import argparse
import io
import sys
from contextlib import redirect_stderr
from dataclasses import make_dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, NoReturn

import tyro

from ..recipe import Recipe

# For whoever asks for help, or for a command that there is not.
USAGE = """\
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


class Parser(argparse.ArgumentParser):
    """A parser that reports errors as the other parts of the command line do."""

    def error(self, message: str) -> NoReturn:
        """Ends the program with one line that says what is wrong with the words."""
        fail(f"{message} (`{self.prog} --help` tells more)")


def add_machine_options(parser: argparse.ArgumentParser) -> None:
    """Options for what a run may do otherwise than its recipe says: where it computes."""
    parser.add_argument("--device", choices=["cpu", "cuda", "auto"], help="the recipe's if missing")
    parser.add_argument("--threads", type=int, help="the recipe's if missing")


def override(recipe: Recipe, **fields: Any) -> Recipe:
    """A recipe with other fields, those that were given."""
    return replace(recipe, **{key: value for key, value in fields.items() if value is not None})


def parse_fields(fields: list[Any], words: list[str], command: str, description: str | None) -> Any:
    """Reads dataclasses from the command line: fields as `make_dataclass` takes them."""
    settings = make_dataclass("settings", fields)
    errors = io.StringIO()
    try:
        with redirect_stderr(errors):
            return tyro.cli(
                tyro.conf.AvoidSubcommands[settings],  # type: ignore[misc, valid-type]
                args=words,
                prog=f"{program()} {command}",
                description=description,
            )
    except SystemExit as stop:
        if stop.code:
            fail(_unboxed(errors.getvalue()))
        raise


def _unboxed(message: str) -> str:
    """What tyro says in a box, as a sentence: the reason, and the options that are like it."""
    lines = [line.strip("│ ") for line in message.splitlines()]
    reason = " ".join(takewhile(lambda line: line[:1] not in "─╰", lines[1:]))
    similar = [line.split()[0] for line in lines if line.startswith("--") and line != "--help"]
    hint = f"; did you mean {' or '.join(similar)}?" if "Perhaps you meant" in message else ""
    return (reason or message) + hint


def program() -> str:
    """What users typed to start this program."""
    name = Path(sys.argv[0]).name
    return "python -m recipes" if name == "__main__.py" else name


def fail(message: str) -> NoReturn:
    """Ends the program with one line that says why."""
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    sys.exit(2)


def summary(recipe: Recipe, evaluation: dict[str, Any]) -> str:
    """An evaluation in one line."""
    return (
        f"{recipe.name}: return {evaluation['mean']:.1f} ± {evaluation['std']:.1f} over "
        f"{evaluation['episodes']} episodes after {evaluation['steps']} steps"
    )
