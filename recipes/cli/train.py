"""`train`: reads the arguments; the rest is in training.py, which is imported only after that.

So help and errors are quick: they need no PyTorch.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchrl_tit.settings import resolve
from torchrl_tit.settings.plugins import load_plugins

from ..recipe import Recipe
from ..registry import find_recipe
from .arguments import Parser, add_machine_options, fail, parse_fields, program
from .backbone_options import check_recipe, choose_network, option_fields


def train(arguments: list[str]) -> None:
    """Trains a new run or one that was stopped, evaluates it and draws its learning curve."""
    if not arguments:
        fail("train needs the name of a recipe first, or --resume RUN")
    if arguments[0].startswith("-"):
        options = _parse_resume(arguments)
        resolve(f"{__package__}.training:resume")(options.resume, options.device, options.threads)
    else:
        recipe, options = _parse_recipe(find_recipe(arguments[0]), arguments[1:])
        resolve(f"{__package__}.training:start")(recipe, options.out, options.init_from)


def _parse_recipe(recipe: Recipe, arguments: list[str]) -> tuple[Recipe, Any]:
    """Overrides a recipe's fields, its network's included, and reads --out and --init-from."""
    out = tyro.conf.arg(help="Run folder to make; runs/NAME/seed-SEED-DATE if missing.")
    init_from = tyro.conf.arg(
        help="Run folder whose newest checkpoint gives the first weights, as far as they fit.",
        metavar="RUN",
    )
    if not {"-h", "--help"}.isdisjoint(arguments):
        load_plugins()  # whose parts are choices, too
    recipe = choose_network(recipe, arguments)
    parsed = parse_fields(
        [
            ("recipe", Annotated[type(recipe), tyro.conf.arg(name="")], recipe),
            *option_fields(recipe),
            ("out", Annotated[Path | None, out], None),
            ("init_from", Annotated[Path | None, init_from], None),
        ],
        arguments,
        f"train {recipe.name}",
        type(recipe).__doc__,
    )
    return check_recipe(parsed.recipe), parsed


def _parse_resume(arguments: list[str]) -> argparse.Namespace:
    parser = Parser(
        f"{program()} train",
        usage="%(prog)s NAME [--FIELD VALUE ...] [--init-from RUN]\n       %(prog)s --resume RUN "
        "[--device DEVICE] [--threads THREADS]",
        description="Train a named recipe, or one in a JSON or Python file; `train NAME --help` "
        "explains every field. Or resume a run that was stopped or killed.",
    )
    parser.add_argument("--resume", type=Path, metavar="RUN", required=True, help="run folder")
    add_machine_options(parser)
    return parser.parse_args(arguments)
