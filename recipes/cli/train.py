"""`train`: parses the arguments; only then is the rest, training.py, imported.

Help and errors are therefore fast: they do not need PyTorch.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchrl_tit.settings import resolve
from torchrl_tit.settings.checks import field_types
from torchrl_tit.settings.imports import load_plugins

from ..core.recipe import Recipe, recipe_classes
from ..core.registry import find_recipe
from ..core.trust import allow_names
from .arguments import Parser, add_machine_options, fail, option, parse_fields, program
from .backbone_options import check_recipe, choose_network, option_fields

_OF_A_RUN = {"--out", "--init-from", "--wandb"}
"""The options of a new run that are not fields of its recipe."""
WANDB_HELP = "Project of Weights & Biases that metrics are sent to, beside CSV and TensorBoard."


def train(arguments: list[str]) -> None:
    """Trains a new run or one that was stopped, evaluates it and draws its learning curve."""
    if not arguments:
        fail("train needs the name of a recipe first, or --resume RUN")
    if arguments[0].startswith("-"):
        options = vars(_parse_resume(arguments))
        run, device, threads = (options.pop(name) for name in ("resume", "device", "threads"))
        lengths = {name: value for name in _lengths() if (value := options[name]) is not None}
        resolve(f"{__package__}.training:resume")(run, device, threads, lengths, options["wandb"])
    else:
        recipe, options = _parse_recipe(find_recipe(arguments[0]), arguments[1:])
        resolve(f"{__package__}.training:start")(
            recipe, options.out, options.init_from, options.wandb
        )


def _parse_recipe(recipe: Recipe, arguments: list[str]) -> tuple[Recipe, Any]:
    """Overrides a recipe's fields, including its network's, and reads --out and --init-from."""
    out = tyro.conf.arg(help="Run folder to make; runs/NAME/seed-SEED-DATE if missing.")
    init_from = tyro.conf.arg(
        help="Run folder whose newest checkpoint gives the first weights, as far as they fit.",
        metavar="RUN",
    )
    wandb = tyro.conf.arg(help=WANDB_HELP, metavar="PROJECT")
    if not {"-h", "--help"}.isdisjoint(arguments):
        load_plugins()  # their parts are choices too
    _check_length(recipe, arguments)
    recipe = choose_network(recipe, arguments)
    parsed = parse_fields(
        [
            ("recipe", Annotated[type(recipe), tyro.conf.arg(name="")], recipe),
            *option_fields(recipe),
            ("out", Annotated[Path | None, out], None),
            ("init_from", Annotated[Path | None, init_from], None),
            ("wandb", Annotated[str | None, wandb], None),
        ],
        arguments,
        f"train {recipe.name}",
        type(recipe),
    )
    checked = check_recipe(parsed.recipe)
    allow_names(checked)
    return checked, parsed


def _check_length(recipe: Recipe, arguments: list[str]) -> None:
    """Exits with a hint if the arguments set the length by another algorithm's field."""
    typed = {argument.partition("=")[0].replace("_", "-") for argument in arguments}
    fields = {option(field) for field in field_types(type(recipe))}
    if not {word for word in typed if word.startswith("--")} - fields - _OF_A_RUN:
        return  # the other algorithms, whose fields they might be, need not be imported
    for length in _lengths():
        if option(length) in typed - fields:
            fail(
                f"{recipe.algorithm} has no {option(length)}: the length of its runs is "
                f"{option(recipe.length)} (see `{program()} train {recipe.name} --help`)"
            )


def _parse_resume(arguments: list[str]) -> argparse.Namespace:
    parser = Parser(
        f"{program()} train",
        usage="%(prog)s NAME [--FIELD VALUE ...] [--init-from RUN]\n       %(prog)s --resume RUN "
        "[--total-steps N] [--device DEVICE] [--threads THREADS]",
        description="Train a named recipe, or one in a JSON or Python file; `train NAME --help` "
        "explains every field. Or resume a run that was stopped or killed, or train a finished one "
        "further.",
    )
    parser.add_argument("--resume", type=Path, metavar="RUN", required=True, help="run folder")
    for length, algorithms in _lengths().items():
        parser.add_argument(
            option(length),
            type=int,
            metavar="N",
            help=f"new length of the whole run ({', '.join(algorithms)})",
        )
    parser.add_argument("--wandb", metavar="PROJECT", help=WANDB_HELP)
    add_machine_options(parser)
    return parser.parse_args(arguments)


def _lengths() -> dict[str, list[str]]:
    """Returns the fields that set the length of a run, each with its algorithms."""
    lengths: dict[str, list[str]] = {}
    for algorithm, kind in recipe_classes().items():
        lengths.setdefault(kind.length, []).append(algorithm)
    return lengths
