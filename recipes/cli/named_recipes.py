"""`list`, `show` and `examples`: the named recipes, and scripts to start from."""

from __future__ import annotations

import shutil
from fnmatch import fnmatchcase
from pathlib import Path

from torchrl_tit.files import whole_or_not_at_all
from torchrl_tit.settings.imports import load_plugins

from ..core.recipe_json import recipe_to_json
from ..core.registry import RECIPES, find_recipe
from .arguments import Parser, fail, note, program, say

_HERE = Path(__file__).parents[2]
"""The installed package, or a clone."""


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


def examples(arguments: list[str]) -> None:
    """Copies the examples into a new folder."""
    parser = Parser(
        "examples",
        "Copy the examples into a new folder: PPO, DQN, SAC and IQL of TorchRL with a TIT "
        "backbone, programs that act from exported files, and a package of encoders, tasks and "
        "algorithms of one's own.",
    )
    parser.add_argument("out", type=Path, metavar="OUT", help="the folder to make")
    out = parser.parse_args(arguments).out
    folders = (_HERE / "examples", _HERE / "docs" / "examples")
    source = next(folder for folder in folders if folder.is_dir())
    out.parent.mkdir(parents=True, exist_ok=True)
    with whole_or_not_at_all(out) as hidden:
        shutil.copytree(source, hidden, ignore=shutil.ignore_patterns("__pycache__", "*.egg-info"))
    say("\n".join(str(path) for path in sorted(out.rglob("*")) if path.is_file()))
