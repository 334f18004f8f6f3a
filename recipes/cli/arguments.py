"""What all commands share: their arguments, users' own modules, and messages of one line."""

from __future__ import annotations

import argparse
import io
import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr
from dataclasses import make_dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, NoReturn

import torchrl_tit
from torchrl_tit.settings.checks import checked, printable
from torchrl_tit.settings.imports import allow, import_allowed

from ..core.recipe import Recipe

IMPORT = "--import"
IMPORT_HELP = (
    "module (or Python file) of your own to import first, for what it registers; can be repeated; "
    "an option of every command"
)

_MODULE_AND_NAME = re.compile(r"(?:--[\w.-]+=)?([A-Za-z_][\w.]*):[A-Za-z_][\w/-]*(?:\(.*\))?")
_OPTION = re.compile(r"--(?:no-)?([A-Za-z][^=]*)")

_OURS = (str(Path(torchrl_tit.__file__).parent), str(Path(__file__).parents[1]))


class Parser(argparse.ArgumentParser):
    """A parser that reports errors as the rest of the command line does.

    Args:
        command: the command.
        description: what it does, for its help.
        **settings: as in :class:`argparse.ArgumentParser`.
    """

    def __init__(self, command: str = "", description: str | None = None, **settings: Any) -> None:
        settings.setdefault("prog", f"{program()} {command}")  # subparsers have their own
        super().__init__(description=description, **settings)
        # Only for the help text: the option itself is parsed before the command is known.
        self.add_argument(IMPORT, metavar="MODULE", help=IMPORT_HELP)

    def error(self, message: str) -> NoReturn:
        """Exits with a one-line message that says what is wrong with the arguments."""
        fail(f"{message} (see `{self.prog} --help`)")


def import_what_is_typed(arguments: list[str]) -> list[str]:
    """Imports the modules of ``--import``, and allows those that other arguments name.

    Args:
        arguments: all arguments of the program.

    Returns:
        The arguments without ``--import``.

    Raises:
        ImportError: if a module cannot be imported.
        ValueError: if the option lacks the module.
    """
    rest, modules = [], []
    words = iter(arguments)
    for word in words:
        option, equals, module = word.partition("=")
        if option == IMPORT:
            modules.append(module if equals else next(words, ""))
        else:
            rest.append(word)
    for module in modules:
        if not module or module.startswith("-"):
            raise ValueError(f"{IMPORT} needs the name of a module, such as my_package")
        import_allowed(module)
    for module in _named(rest):
        allow(module)
    return rest


def refuse_repeated(arguments: list[str]) -> None:
    """Raises ValueError if an option is typed twice, since only the last would count."""
    typed: set[str] = set()
    for found in filter(None, map(_OPTION.match, arguments)):
        name = found[1].replace("_", "-")
        if name in typed:
            raise ValueError(
                f"--{name} is there twice: type it once, with all its values behind it, such as "
                "--seeds 0 1"
            )
        typed.add(name)


def _named(arguments: list[str]) -> Iterator[str]:
    """Modules in arguments such as ``module:Task-v0``: users who type one want it imported."""
    for argument in arguments:
        found = _MODULE_AND_NAME.fullmatch(argument)
        # `hf:user/name` is an agent, whose files are not the user's own word.
        if found and found[1] != "hf" and not found[1].endswith((".", ".py")):
            yield found[1]


def add_agent(parser: argparse.ArgumentParser, **settings: Any) -> None:
    """Adds the arguments that name a trained agent."""
    words = "run folder, or a name that `play` lists, folder of an agent, hf:user/name on the Hub"
    parser.add_argument("agent", metavar="AGENT", help=words, **settings)
    add_best(parser)


def add_best(parser: argparse.ArgumentParser) -> None:
    """Adds the choice between the weights of a run."""
    words = "of a run: the weights with the highest return so far, not the last ones"
    parser.add_argument("--best", action="store_true", help=words)


def add_machine_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options for device and threads, which override those of the recipe."""
    parser.add_argument("--device", help="such as cuda:1, or auto; default: the recipe's")
    parser.add_argument("--threads", type=int, help="default: the recipe's")


def check_numbers(options: argparse.Namespace, **kinds: Any) -> None:
    """Raises ValueError if an option is out of the bounds of its type; None is not checked."""
    for name, kind in kinds.items():
        checked(option(name), getattr(options, name), kind | None)


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


def parse_fields(fields: list[Any], arguments: list[str], command: str, description: str) -> Any:
    """Reads dataclasses from the command line.

    Args:
        fields: what to read, as :func:`dataclasses.make_dataclass` takes it.
        arguments: the arguments after the command's name.
        command: the command, for the help.
        description: what starts the help.
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
                description=f"{description}\n\n{IMPORT} MODULE: {IMPORT_HELP}.",
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


@contextmanager
def one_line_warnings() -> Iterator[None]:
    """Writes warnings as "warning: TEXT", without the source that Python shows.

    Warnings of other libraries are followed by their location. Python repeats a warning whenever
    the filters have changed, and TorchRL and Gymnasium change them; here each text is printed once.
    """
    shown: set[str] = set()

    def write(
        message: Warning | str, category: type, filename: str, lineno: int, line: str | None = None
    ) -> str:
        text = f"warning: {printable(' '.join(str(message).split()))}"
        if not filename.startswith(_OURS):
            text += f" ({filename}:{lineno})"
        if text in shown:
            return ""
        shown.add(text)
        return f"{text}\n"

    before = warnings.formatwarning
    warnings.formatwarning = write
    try:
        yield
    finally:
        warnings.formatwarning = before
