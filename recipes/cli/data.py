"""`data`: parses the arguments, and only then imports the rest.

Help and errors are therefore fast: they do not need PyTorch.
"""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Annotated

import tyro

from torchrl_tit.settings import resolve
from torchrl_tit.settings.imports import import_options

from ..collect import Collection
from .arguments import Parser, note, parse_fields, program, say


def data(arguments: list[str]) -> None:
    """Describes data sets, converts them, or makes them."""
    if arguments[:1] == ["collect"]:
        return _collect(arguments[1:])
    parser = Parser(f"{program()} data")
    _add_options(parser)
    say(resolve(f"{__package__}.data_sets:run")(parser.parse_args(arguments)))


def _collect(arguments: list[str]) -> None:
    out = tyro.conf.arg(help="Folder of the data, which the same command resumes.")
    parsed = parse_fields(
        [
            ("collection", Annotated[Collection, tyro.conf.arg(name="")]),
            ("out", Annotated[Path, out]),
        ],
        arguments,
        "data collect",
        Collection,
    )
    words = [*program().split(), "data", "collect", *arguments, *import_options()]
    try:
        collect = resolve(f"{__package__}.data_sets:collect")
        lines = collect(parsed.collection, parsed.out, shlex.join(words))
    except KeyboardInterrupt:
        note("stopped; the same command resumes", "")
        raise
    say("\n".join(lines))


def _add_options(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(
        dest="command", required=True, metavar="info | convert | collect"
    )
    info = commands.add_parser("info", help="describe a data set")
    convert = commands.add_parser("convert", help="convert between D4RL's HDF5 and Minari")
    # Its options are the fields of a dataclass, which parse_fields reads.
    commands.add_parser("collect", add_help=False, help="make data sets of a task, as D4RL does")
    for command in (info, convert):
        command.add_argument("source", help="HDF5 file, Minari folder, D4RL's or Minari's name")
        command.add_argument("--env", help="Gymnasium task that the data must fit")
        command.add_argument(
            "--max-episode-steps", type=int, help="time limit of a file without timeouts"
        )
        command.add_argument(
            "--gaps",
            choices=["error", "cut"],
            default="error",
            help="refuse data where an episode continues with another observation than its next "
            "one, or end the episode there",
        )
        command.add_argument("--directory", type=Path, help="folder for temporary files")
    convert.add_argument("target", help="HDF5 file, Minari folder (/PATH-v0 or ./PATH-v0) or name")
