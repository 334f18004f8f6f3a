"""`report`: everything about one or several runs as one HTML file."""

from __future__ import annotations

from pathlib import Path

from .arguments import Parser, program, say


def report(arguments: list[str]) -> None:
    """Writes a report of runs."""
    parser = Parser(
        f"{program()} report",
        description="Write everything about runs into one HTML file that needs no network: results "
        "beside the paper's, learning curves, metrics of health with their meaning, a film, what "
        "the agent looks at, settings and versions. Several runs make a comparison.",
    )
    parser.add_argument(
        "runs",
        type=Path,
        nargs="+",
        metavar="RUN",
        help="run folders, or tables of runs",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the .html file")
    parser.add_argument("--title", default="", help="title of the report; default: the recipe's")
    parser.add_argument(
        "--no-pictures",
        action="store_true",
        help="leave out the film and what the agent looks at, which take most of the time",
    )
    options = parser.parse_args(arguments)
    # Not at the top: it needs an extra, and help needs no PyTorch.
    from ..tools.results.report import report as write

    write(
        options.runs,
        options.out,
        title=options.title,
        pictures=not options.no_pictures,
        say=say,
    )
    size = options.out.stat().st_size / 1e6
    say(f"written to {options.out}: {size:.1f} MB, which needs no network")
