"""`compare`, `table`, `record`, `report`: several runs side by side."""

from __future__ import annotations

from pathlib import Path

from .arguments import Parser, fail, note, say

# What needs PyTorch or an extra is imported once the arguments are read: help is fast.


def compare(arguments: list[str]) -> None:
    """Plots learning curves of several runs, and says which are better."""
    parser = Parser(
        "compare",
        "Plot learning curves of runs, a recipe's seeds as one band, and print how the evaluations "
        "of each recipe differ from those of the first: probability of improvement, permutation "
        "test, and the number of seeds that such a difference needs.",
    )
    parser.add_argument("runs", type=Path, nargs="+", help="folders of runs, or tables of runs")
    parser.add_argument("--out", type=Path, default=Path("comparison.png"), help="PNG to write")
    parser.add_argument("--title", default="", help="title of the figure")
    options = parser.parse_args(arguments)
    if options.out.suffix != ".png":
        fail(f"--out {options.out} must end in .png: the figure is a PNG")
    from ..tools.results.comparison import HEADER, WORDS, compare_with_first
    from ..tools.results.experiments import check_together, find_runs, group_runs
    from ..tools.results.plot import plot_comparison
    from ..tools.results.table import read_evaluations, to_lines, value_of

    # The logs of a sweep lie next to its runs, so `sweep/*/seed-*` matches them too.
    folders = {path.resolve(): path for path in options.runs if path.suffix != ".log"}
    if not folders:
        fail(f"{options.runs[0]} is not a run folder, but a log: name the folder beside it")
    experiments = group_runs(find_runs(folders.values()))
    notes = check_together(experiments)
    notes += plot_comparison(experiments, options.out, title=options.title)
    say(f"written to {options.out}")
    evaluated, left_out = read_evaluations(folders.values())
    lengths = sorted({evaluation["steps"] for _, found in evaluated for evaluation in found})
    if len(lengths) > 1:
        notes.append(f"the runs were evaluated after {', '.join(map(str, lengths))} steps")
    for line in [*notes, *left_out]:
        note(line)
    labels = {run.folder: one.label for one in experiments for run in one.runs}
    named = [(labels[x.runs[0].folder], [*map(value_of, found)]) for x, found in evaluated]
    if rows := compare_with_first(named):
        say("\n".join(["", *to_lines(HEADER, rows), "", WORDS]))


def summary(arguments: list[str]) -> None:
    """Summarizes the runs of networks over several tasks."""
    parser = Parser(
        "summary",
        "Print the interquartile mean of each network's returns over all tasks that all of them "
        "have, normalized by a random policy and the best published PPO, and the probability that "
        "it improves on the first (arXiv 2108.13264). All tasks count equally, so runs at the ends "
        "of the middle half count in part; `table` leaves out whole runs.",
    )
    parser.add_argument("folders", type=Path, nargs="+", help="folders of runs, or tables of runs")
    parser.add_argument(
        "--networks",
        nargs="+",
        default=[],
        metavar="PATTERN",
        help="which runs belong together, the first to compare with: patterns of the last part of "
        "a recipe's name, such as 'enhanced-tit*'; default: those with the same last part",
    )
    parser.add_argument(
        "--references",
        type=Path,
        metavar="FILE",
        help="CSV file with the columns env, random and best, instead of the returns that come "
        "with the package",
    )
    options = parser.parse_args(arguments)
    from ..tools.results.comparison import SUMMARY, read_networks, summarize
    from ..tools.results.table import to_lines

    networks, notes = read_networks(options.folders, options.networks, options.references)
    for line in notes:
        note(line)
    say("\n".join(to_lines(SUMMARY, summarize(networks))))


def table(arguments: list[str]) -> None:
    """Prints the paper's tables for the runs in the folders."""
    parser = Parser("table", "Print the paper's tables with all runs in the folders.")
    parser.add_argument("folders", type=Path, nargs="+", help="folders of runs, or tables of runs")
    parser.add_argument("--format", choices=["md", "csv"], default="md", help="format to print")
    parser.add_argument("--out", type=Path, help="folder for table.md, table.csv and table.png")
    options = parser.parse_args(arguments)
    if options.out is not None and options.out.is_file():
        fail(f"--out {options.out} is a file, but must be a folder, for the table in three formats")
    from torchrl_tit.files import write_text_atomic

    from ..tools.results.table import make_table, plot_table, to_csv, to_markdown

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


def record(arguments: list[str]) -> None:
    """Adds runs to a table of runs."""
    parser = Parser(
        "record",
        "Add finished runs to a table of runs, which is small enough to lie beside the code: "
        "settings, versions, evaluations and metrics of four digits, without checkpoints. compare, "
        "table and report read it as they read run folders.",
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
    from ..core.records import Records
    from ..core.run import RecordedRun
    from ..tools.results.recording import record_runs

    names = record_runs(options.runs, options.out, under=options.under, commit=options.commit)
    table = Records(options.out)
    for name in names:
        run = RecordedRun(table, name)
        if (run.read_evaluation() or {"steps": 0})["steps"] < run.recipe.final_step:
            note(f"{name} has not ended, or is not evaluated: record it again once it is")
        say(str(options.out / name))
    say(f"{len(names)} recorded in {options.out}")


def report(arguments: list[str]) -> None:
    """Writes a report of runs."""
    parser = Parser(
        "report",
        "Write everything about runs into one HTML file that needs no network: results beside the "
        "paper's, learning curves, metrics of health with their meaning, a film, what the agent "
        "looks at, settings and versions. Several runs make a comparison.",
    )
    parser.add_argument(
        "runs", type=Path, nargs="+", metavar="RUN", help="run folders, or tables of runs"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the .html file")
    parser.add_argument("--title", default="", help="title of the report; default: the recipe's")
    parser.add_argument(
        "--no-pictures",
        action="store_true",
        help="leave out the film and what the agent looks at, which take most of the time",
    )
    options = parser.parse_args(arguments)
    from ..tools.results.report import report as write

    pictures = not options.no_pictures
    write(options.runs, options.out, title=options.title, pictures=pictures, say=say)
    size = options.out.stat().st_size / 1e6
    say(f"written to {options.out}: {size:.1f} MB, which needs no network")
