"""Which commands there are."""

from __future__ import annotations

import sys
from fnmatch import fnmatchcase

from ..recipe import recipe_to_json
from ..registry import RECIPES, find_recipe
from .finished import compare, evaluate, render, table
from .many import sweep, tune
from .train import train
from .words import USAGE, Parser, fail, program


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line.

    Args:
        arguments: the words after the program's name; those of this process where None.
    """
    words = sys.argv[1:] if arguments is None else arguments
    commands = {
        "list": list_recipes,
        "show": show,
        "train": train,
        "evaluate": evaluate,
        "render": render,
        "sweep": sweep,
        "tune": tune,
        "compare": compare,
        "table": table,
        "data": _data,
    }
    if not words or words[0] not in commands:
        asked = not words or words[0] in ("-h", "--help")
        print(USAGE.format(program=program()), file=sys.stdout if asked else sys.stderr)
        if not asked:
            fail(f"unknown command {words[0]!r}: choose from {', '.join(commands)}")
        return
    try:
        commands[words[0]](words[1:])
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:  # `list | head`: nobody reads on
        sys.stdout = None
    except (ValueError, OSError, RuntimeError, FloatingPointError) as error:
        fail(str(error))


def list_recipes(words: list[str]) -> None:
    """Names of recipes."""
    parser = Parser(f"{program()} list")
    parser.add_argument("pattern", nargs="?", default="", help="part of a name; * is any text")
    pattern = parser.parse_args(words).pattern
    names = [name for name in RECIPES if fnmatchcase(name, f"*{pattern.lower()}*")]
    if not names:
        fail(f"no recipe contains {pattern!r}: `{program()} list` names all of them")
    print("\n".join(names))


def show(words: list[str]) -> None:
    """A recipe as JSON."""
    parser = Parser(f"{program()} show")
    parser.add_argument("name", help="name of a recipe, or a JSON file")
    print(recipe_to_json(find_recipe(parser.parse_args(words).name)), end="")


def _data(words: list[str]) -> None:
    from .data import data  # takes a second that others save

    data(words)
