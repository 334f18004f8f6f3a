"""Parsing of a command's arguments, with one-line error messages."""

from __future__ import annotations

import argparse
import io
import sys
from contextlib import redirect_stderr
from dataclasses import make_dataclass, replace
from inspect import getdoc
from itertools import takewhile
from pathlib import Path
from typing import Any, NoReturn

from torchrl_tit.settings.checks import printable
from torchrl_tit.settings.numbers import MAX_SEED

from ..recipe import Recipe
from .imports import HELP, OPTION


class Parser(argparse.ArgumentParser):
    """A parser that reports errors as the rest of the command line does."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # Only for the help text: the option itself is parsed before the command is known.
        self.add_argument(OPTION, metavar="MODULE", help=HELP)

    def error(self, message: str) -> NoReturn:
        """Exits with a one-line message that says what is wrong with the arguments."""
        fail(f"{message} (see `{self.prog} --help`)")


def add_machine_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options for device and threads, which override those of the recipe."""
    parser.add_argument("--device", choices=["cpu", "cuda", "auto"], help="default: the recipe's")
    parser.add_argument("--threads", type=int, help="default: the recipe's")


def check_seed(seed: int | None) -> None:
    """Exits with an error unless the seed is None or one that environments accept."""
    if seed is not None and not 0 <= seed <= MAX_SEED:
        fail(f"--seed must be from 0 to {MAX_SEED}, not {seed}")


def option(field: str) -> str:
    """Returns a field as the option that users type.

    Example:
        >>> option("total_steps")
        '--total-steps'
    """
    return f"--{field.replace('_', '-')}"


def override(recipe: Recipe, **fields: Any) -> Recipe:
    """Returns the recipe with the given fields replaced; None leaves a field unchanged."""
    return replace(recipe, **{key: value for key, value in fields.items() if value is not None})


def parse_fields(fields: list[Any], arguments: list[str], command: str, described: type) -> Any:
    """Reads dataclasses from the command line.

    Args:
        fields: what to read, as :func:`dataclasses.make_dataclass` takes it.
        arguments: the arguments after the command's name.
        command: the command, for the help.
        described: the class whose docstring starts the help.
    """
    import tyro  # takes half a second; other commands do not need it

    settings = make_dataclass("settings", fields)
    errors = io.StringIO()
    try:
        with redirect_stderr(errors):
            return tyro.cli(
                tyro.conf.AvoidSubcommands[settings],  # type: ignore[misc, valid-type]
                args=arguments,
                prog=f"{program()} {command}",
                description=f"{getdoc(described)}\n\n{OPTION} MODULE: {HELP}.",
            )
    except SystemExit as stop:
        if stop.code:
            fail(_unboxed(errors.getvalue()))
        raise


def _unboxed(message: str) -> str:
    """Turns tyro's box into one sentence: the reason, and similar options if there are any."""
    lines = [line.strip("│ ") for line in message.splitlines()]
    reason = " ".join(takewhile(lambda line: line[:1] not in "─╰", lines[1:]))
    words = [line.split()[0] for line in lines if line.startswith("--") and line != "--help"]
    similar = [word for word in words if not word.endswith((".", ","))]  # not those of help texts
    hint = (
        f"; did you mean {' or '.join(similar)}?"
        if similar and "Perhaps you meant" in message
        else ""
    )
    return (reason or message) + hint


def program() -> str:
    """Returns what users type to start this program."""
    name = Path(sys.argv[0]).name
    return "python -m recipes" if name == "__main__.py" else name


def say(text: str) -> None:
    """Prints lines; all text of a command passes here, or below, as it may come from files."""
    print("\n".join(map(printable, text.split("\n"))))


def note(text: str, kind: str = "note: ") -> None:
    """Prints a line to standard error."""
    print(f"{kind}{printable(' '.join(text.split()))}", file=sys.stderr)


def fail(message: str) -> NoReturn:
    """Exits with a one-line error message."""
    note(message, "error: ")
    sys.exit(2)
