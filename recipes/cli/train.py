"""`train`: parses the arguments; only then is the rest, training.py, imported.

Help and errors are therefore fast: they do not need PyTorch.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from inspect import getdoc
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchrl_tit.settings import resolve
from torchrl_tit.settings.imports import load_plugins

from ..core.recipe import LENGTHS, Recipe
from ..core.registry import find_recipe
from ..core.trust import allow_names
from .arguments import Parser, add_machine_options, fail, option, parse_fields, program
from .backbone_options import check_recipe, choose_network, describe_options

WANDB_HELP = "Project of Weights & Biases that metrics are sent to, beside CSV and TensorBoard."


def train(arguments: list[str]) -> None:
    """Trains a new run or one that was stopped, evaluates it and draws its learning curve."""
    if not arguments:
        fail("train needs the name of a recipe first, or --resume RUN")
    if arguments[0].startswith("-"):
        options = _parse_resume(arguments)
        resolve(f"{__package__}.training:resume")(
            options.resume, options.device, options.threads, options.lengths, options.wandb
        )
    else:
        recipe, options = _parse_train(find_recipe(arguments[0]), arguments[1:])
        resolve(f"{__package__}.training:start")(
            recipe, options.out, options.init_from, options.wandb
        )


def _parse_train(recipe: Recipe, arguments: list[str]) -> tuple[Recipe, Any]:
    """Overrides a recipe's fields, and reads --out, --init-from and --wandb."""
    out = tyro.conf.arg(help="Run folder to make; runs/NAME/seed-SEED-DATE if missing.")
    init_from = tyro.conf.arg(
        help="Run folder whose newest checkpoint gives the first weights, as far as they fit.",
        metavar="RUN",
    )
    wandb = tyro.conf.arg(help=WANDB_HELP, metavar="PROJECT")
    beside = [
        ("out", Annotated[Path | None, out], None),
        ("init_from", Annotated[Path | None, init_from], None),
        ("wandb", Annotated[str | None, wandb], None),
    ]
    return parse_recipe(recipe, arguments, f"train {recipe.name}", beside)


def parse_recipe(
    recipe: Recipe, arguments: list[str], command: str, beside: Sequence[Any] = ()
) -> tuple[Recipe, Any]:
    """Overrides a recipe's fields, including its network's.

    Args:
        recipe: the recipe.
        arguments: the arguments after its name.
        command: the command, for messages.
        beside: further options of the command, as :func:`dataclasses.make_dataclass` takes them.

    Returns:
        The recipe, and an object with the values of the further options.
    """
    if not {"-h", "--help"}.isdisjoint(arguments):
        load_plugins()  # their parts are choices too
    _check_length(recipe, arguments)
    recipe, rest = choose_network(recipe, arguments)
    parsed = parse_fields(
        [("recipe", Annotated[type(recipe), tyro.conf.arg(name="")], recipe), *beside],
        rest,
        command,
        f"{getdoc(type(recipe))}\n\n{describe_options(recipe)}",
    )
    checked = check_recipe(parsed.recipe)
    allow_names(checked)
    return checked, parsed


def _check_length(recipe: Recipe, arguments: list[str]) -> None:
    """Exits with a hint if the arguments set the length by another algorithm's field."""
    typed = {argument.partition("=")[0].replace("_", "-") for argument in arguments}
    for length in LENGTHS:
        if option(length) in typed and not hasattr(recipe, length):
            fail(
                f"{recipe.algorithm} has no {option(length)}: the length of its runs is "
                f"{option(recipe.length)} (see `{program()} train {recipe.name} --help`)"
            )


def _parse_resume(arguments: list[str]) -> argparse.Namespace:
    parser = Parser(
        "train",
        "Train a named recipe, or one in a JSON or Python file; `train NAME --help` explains every "
        "field. Or resume a run that was stopped or killed, or train a finished one further.",
        usage="%(prog)s NAME [--FIELD VALUE ...] [--init-from RUN]\n       %(prog)s --resume RUN "
        "[--total-steps N] [--device DEVICE] [--threads THREADS]",
    )
    parser.add_argument("--resume", type=Path, metavar="RUN", required=True, help="run folder")
    imported = [kind.length for kind in Recipe.registered.values()]  # of one's own algorithms
    lengths = dict.fromkeys([*LENGTHS, *imported])
    for length in lengths:
        words = "new length of the whole run, where this is the field that sets it"
        parser.add_argument(option(length), type=int, metavar="N", help=words)
    parser.add_argument("--wandb", metavar="PROJECT", help=WANDB_HELP)
    add_machine_options(parser)
    options = parser.parse_args(arguments)
    typed = {name: getattr(options, name) for name in lengths}
    options.lengths = {name: value for name, value in typed.items() if value is not None}
    return options
