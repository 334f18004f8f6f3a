"""`list` and `show`: the named recipes."""

from __future__ import annotations

from fnmatch import fnmatchcase

from torchrl_tit.settings.imports import load_plugins

from ..core.recipe_json import recipe_to_json
from ..core.registry import RECIPES, find_recipe
from .arguments import Parser, fail, note, program, say


def list_recipes(arguments: list[str]) -> None:
    """Prints the names of recipes, including those of installed packages."""
    parser = Parser("list", "List the named recipes.")
    parser.add_argument("pattern", nargs="?", default="", help="part of a name; * is any text")
    pattern = parser.parse_args(arguments).pattern
    for failure in load_plugins():
        note(failure)
    names = [name for name in RECIPES if fnmatchcase(name, f"*{pattern.lower()}*")]
    if not names:
        fail(f"no recipe's name contains {pattern!r}: `{program()} list` prints all names")
    say("\n".join(names))


def show(arguments: list[str]) -> None:
    """Prints a recipe as JSON."""
    parser = Parser("show", "Print a recipe's settings as JSON.")
    parser.add_argument("name", help="name of a recipe, or a JSON or Python file")
    say(recipe_to_json(find_recipe(parser.parse_args(arguments).name)).rstrip("\n"))
