"""`compare` and `table`: several runs side by side."""

from __future__ import annotations

from pathlib import Path

from torchrl_tit.files import write_text_atomic

from ..tools.results.experiments import check_together, find_runs, group_runs
from ..tools.results.plot import plot_comparison, plot_table
from ..tools.results.table import make_table, to_csv, to_markdown
from .arguments import Parser, fail, note, program, say


def compare(arguments: list[str]) -> None:
    """Plots learning curves of several runs."""
    parser = Parser(f"{program()} compare")
    parser.add_argument("runs", type=Path, nargs="+", help="run folders, or tables of runs")
    parser.add_argument("--out", type=Path, default=Path("comparison.png"), help="PNG to write")
    parser.add_argument("--title", default="", help="title of the figure")
    options = parser.parse_args(arguments)
    if options.out.suffix != ".png":
        fail(f"--out {options.out} must end in .png: the figure is a PNG")
    # The logs of a sweep lie next to its runs, so `sweep/*/seed-*` matches them too.
    folders = {path.resolve(): path for path in options.runs if path.suffix != ".log"}
    if not folders:
        fail(f"{options.runs[0]} is not a run folder, but a log: name the folder beside it")
    experiments = group_runs(find_runs(folders.values()))
    check_together(experiments)
    plot_comparison(experiments, options.out, title=options.title)
    say(f"written to {options.out}")


def table(arguments: list[str]) -> None:
    """Prints the paper's tables for the runs in the folders."""
    parser = Parser(f"{program()} table")
    parser.add_argument("folders", type=Path, nargs="+", help="folders of runs, or tables of runs")
    parser.add_argument("--format", choices=["md", "csv"], default="md", help="format to print")
    parser.add_argument("--out", type=Path, help="folder for table.md, table.csv and table.png")
    options = parser.parse_args(arguments)
    cells, notes = make_table(options.folders)
    for line in notes:
        note(line)
    say((to_csv(cells) if options.format == "csv" else to_markdown(cells)).rstrip("\n"))
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        write_text_atomic(options.out / "table.md", to_markdown(cells))
        write_text_atomic(options.out / "table.csv", to_csv(cells))
        plot_table(cells, options.out / "table.png")
        say(f"written to {options.out}")
