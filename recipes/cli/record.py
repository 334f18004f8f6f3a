"""`record`: finished runs in a table of runs."""

from __future__ import annotations

from pathlib import Path

from ..tools.results.recording import record_runs
from .arguments import Parser, program, say


def record(arguments: list[str]) -> None:
    """Adds runs to a table of runs."""
    parser = Parser(
        f"{program()} record",
        description="Add finished runs to a table of runs, which is small enough to lie beside the "
        "code: settings, versions, evaluations and metrics of four digits, without checkpoints. "
        "compare, table and report read it as they read run folders.",
    )
    parser.add_argument(
        "runs", type=Path, nargs="+", metavar="RUN", help="run folders, or folders of run folders"
    )
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FOLDER", help="folder of the table"
    )
    parser.add_argument(
        "--under", default="", metavar="PATH", help="path in the table; default: its top"
    )
    parser.add_argument("--commit", default="", help="commit of the code that the runs had")
    options = parser.parse_args(arguments)
    names = record_runs(options.runs, options.out, under=options.under, commit=options.commit)
    for name in names:
        say(str(options.out / name))
    say(f"{len(names)} recorded in {options.out}")
