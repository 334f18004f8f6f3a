"""Writes the tables of pages from the data beside them: ``python -m docs.tools.tables``.

A table stands between two comments. The first says where its numbers are from, below docs/results:

    <!-- table: hopper
    | recipe | weights | return | each seed |
    = {1} | {2} | {mean} | {each}
    mlp: `ppo/hopper/mlp` | 10,119
    enhanced-tit-tuned: `ppo/hopper/enhanced-tit-tuned` | 55,943
    -->
    ...
    <!-- end -->

The first row is the header. ``=`` gives the form of the rows that follow: each names its runs and,
after a colon, the cells that are not measured. A line that begins with ``|`` is a row with its own
form. ``{mean}`` is a measure of :data:`MEASURES`, ``{mean @ hopper/mlp}`` that of the runs of a
path below docs/results, ``{mean @ ./mlp}`` below the row's path, ``{median FILE.json / KEY / ...}``
a number of a benchmark. Where a row names ``FILE.json / KEY``, or a key below ``<!-- table:
FILE.json``, a measure names the rest: ``{median KEY / ...}``. A path may have a ``*``: ``{overall @
update_size/new_seeds/*/lstm}`` is the interquartile mean over tasks, and ``{improvement @ PATH}``
compares a row's runs with others, also of ``sb3.csv stable_baselines3=2.9.2``. Means of fewer than
five seeds are marked, and a line below the table says so.

A folder ``paper/...`` is a table of docs/paper.md, which :mod:`docs.tools.paper` prints.

With ``--check``, pages that differ from their data are named, and nothing is written.
"""

from __future__ import annotations

import csv
import io
import json
import re
import sys
from collections.abc import Callable, Container, Iterator, Sequence
from fnmatch import fnmatchcase
from functools import cache
from itertools import pairwise
from pathlib import Path, PurePosixPath
from statistics import fmean, median
from typing import Any

import numpy as np

from docs.tools import paper
from recipes.core.numbers import mean_std, number, numbers
from recipes.core.records import Records
from recipes.core.run import RecordedRun
from recipes.tools.results.comparison import (
    interquartile_mean,
    normalize,
    probability_of_improvement,
    read_references,
)
from recipes.tools.results.interval import FEWEST, interval_of
from recipes.tools.results.paper import match
from torchrl_tit.files import write_text_atomic

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "docs" / "results"
PAGES = ("*.md", "docs/**/*.md")

_TABLE = re.compile(r"(<!-- table: *(\S*)\n(.*?)-->\n)(.*?)(<!-- end -->)", re.DOTALL)
_MEASURE = re.compile(r"\{([^{}]+)\}")
_MARK = "†"
_FEW = f"\n{_MARK} Fewer than five seeds: too few for a comparison.\n"


class Runs:
    """What a row measures: runs, or rows of a CSV file, in the order of their seeds.

    Args:
        path: a path in a table of runs below docs/results; with a space between, several; or a CSV
            file and a value of its first column, such as "memory/s7.csv ppo/memory-s7/lstm", or
            "COLUMN=VALUE", several joined by " & ".
    """

    def __init__(self, path: str) -> None:
        self.rows: list[dict[str, str]] = []
        self.runs: list[tuple[Records, str]] = []
        name, _, value = path.partition(" ")
        if name.endswith(".csv"):
            with (RESULTS / name).open(newline="", encoding="utf-8") as file:
                rows = list(csv.DictReader(file))
            for condition in value.split(" & "):
                column, _, wanted = condition.rpartition("=")
                rows = [row for row in rows if row[column or next(iter(row))] == wanted]
            self.rows = rows
        else:
            for name in path.split():
                found = list(_runs_below(name))
                if not found:
                    raise ValueError(f"docs/results has no run {name}")
                self.runs += found
            self.runs.sort(key=lambda pair: int(pair[0].rows[pair[1]]["seed"]))
            self.rows = [records.rows[run] for records, run in self.runs]
        if not self.rows:
            raise ValueError(f"docs/results has no run {path}")

    def numbers(self, column: str) -> list[float]:
        """A number of each run's row."""
        return [float(row[column]) for row in self.rows]

    def evaluations(self) -> list[dict[str, Any]]:
        """Each run's evaluation."""
        found = [records.read(run, "evaluation.json") for records, run in self.runs]
        return [json.loads(content) for content in found if content is not None]

    def curves(self) -> list[dict[str, np.ndarray]]:
        """Each run's metrics."""
        return [_curve(records, run) for records, run in self.runs]


def _runs_below(path: str) -> Iterator[tuple[Records, str]]:
    page, _, below = path.partition("/")
    records = _records(page)
    star = "*" in below
    for run in records.rows if star else records.below(below):
        if not star or fnmatchcase(str(PurePosixPath(run).parent), below):
            yield records, run


@cache
def _records(page: str) -> Records:
    return Records(RESULTS / page)


@cache
def _curve(records: Records, run: str) -> dict[str, np.ndarray]:
    rows = list(csv.DictReader(io.StringIO((records.read(run, "metrics.csv") or b"").decode())))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


@cache
def _json(name: str) -> Any:
    return json.loads((RESULTS / name).read_bytes())


def _mean(values: Sequence[float]) -> str:
    """A mean and its deviation; of too few seeds, with the mark of :data:`_FEW`."""
    return mean_std(values) + _MARK * (len(values) < FEWEST)


def _list(values: Sequence[float]) -> str:
    texts = numbers(values)
    return f"{texts[0]} each" if len(texts) > 2 and len({*texts}) == 1 else ", ".join(texts)


def _range(values: Sequence[float]) -> str:
    low, high = numbers([min(values), max(values)])
    return low if low == high else f"{low} to {high}"


def _around(values: Sequence[float]) -> str:
    """A mean and its range."""
    middle, *ends = numbers([fmean(values), min(values), max(values)])
    return _list(values) if ends[0] == ends[1] else f"{middle} ({' to '.join(ends)})"


def _seeds(runs: Runs) -> str:
    seeds = sorted(int(row["seed"]) for row in runs.rows)
    if len(seeds) > 2 and all(after - before == 1 for before, after in pairwise(seeds)):
        return f"{seeds[0]} to {seeds[-1]}"
    return ", ".join(map(str, seeds))


def _values(runs: Runs) -> list[float]:
    """Each run's evaluation: its mean return, or the mean of a CSV file."""
    return runs.numbers("mean" if runs.runs else "evaluation")


def _normalized(runs: Runs, tasks: Container[Any] | None = None) -> dict[Any, list[float]]:
    """The normalized returns of each of the tasks; a row of a CSV file has the task's name."""
    found: dict[Any, list[float]] = {}
    pairs: Sequence[tuple[Records, str] | None] = runs.runs or [None] * len(runs.rows)
    of = zip(pairs, runs.rows, _values(runs), strict=True)
    for pair, row, value in of:
        if pair is None:
            task = (row["env"], False)
        else:
            recipe = RecordedRun(*pair).recipe
            task = (recipe.env, getattr(recipe, "hide_velocities", False))
        if tasks is None or task in tasks:
            found.setdefault(task, []).extend(normalize([value], task[0], read_references()))
    return found


def _scores(runs: Runs, which: str) -> list[float]:
    return [evaluation["score"][which] for evaluation in runs.evaluations()]


def _tail(runs: Runs, column: str, begin: float, end: float = np.inf) -> list[float]:
    """Means of a metric over rows of a run, those between two steps."""
    means = []
    for curve in runs.curves():
        steps, values = curve["step"], curve[column]
        counts = (steps > begin) & (steps <= end) & np.isfinite(values)
        means.append(float(values[counts].mean()) if counts.any() else float("nan"))
    return means


def _last(runs: Runs, column: str, share: float) -> list[float]:
    """Means of a metric over the last share of a run's steps."""
    means = []
    for curve in runs.curves():
        steps, values = curve["step"], curve[column]
        counts = (steps > (1 - share) * steps[-1]) & np.isfinite(values)
        means.append(float(values[counts].mean()))
    return means


def _over(runs: Runs, column: str, reduce: Callable[..., Any]) -> list[float]:
    return [float(reduce(curve[column])) for curve in runs.curves()]


def _at(runs: Runs, column: str, step: str) -> list[float]:
    """A metric at a step of each run; "last" is its last row, "best" its highest value."""
    found = []
    for curve in runs.curves():
        values = curve[column]
        if step in ("last", "best"):
            found.append(float(np.nanmax(values) if step == "best" else values[-1]))
        else:
            found.append(float(values[curve["step"] == float(step)][0]))
    return found


def _paper(runs: Runs) -> str:
    """The paper's number, marked as near if the runs have other settings."""
    found = match(RecordedRun(*runs.runs[0]).recipe)
    assert found is not None
    return f"{'near ' * bool(found.differs)}{found.cell}"


def _reaches(runs: Runs, column: str, least: float) -> str:
    """The thousands of steps until a metric's mean over 100 or more episodes is high enough."""
    found = []
    for curve in runs.curves():
        ends, begin, reached = np.nancumsum(curve["episodes"]), 0, ""
        totals = np.nancumsum(curve[column] * curve["episodes"])
        for index, step in enumerate(curve["step"]):
            while begin < index and ends[index] - ends[begin] >= 100:
                begin += 1
            since = (ends[begin - 1], totals[begin - 1]) if begin else (0, 0)
            count = ends[index] - since[0]
            if count >= 100 and (totals[index] - since[1]) / count >= least:
                reached = str(step)
                break
        found.append(_thousands(reached))
    return ", ".join(found)


def _thousands(steps: str) -> str:
    return f"{float(steps) / 1000:.0f}" if steps else "not"


def _successes(runs: Runs) -> str:
    texts = numbers(runs.numbers("success"))
    same = len(texts) > 1 and len({*texts}) == 1
    return f"{len(texts)} x {texts[0]}" if same else ", ".join(texts)


def _reached(runs: Runs) -> str:
    return ", ".join(_thousands(row["steps_to_0.9"]) for row in runs.rows)


def _reached_by(runs: Runs) -> str:
    reached = [float(row["steps_to_0.9"]) / 1000 for row in runs.rows if row["steps_to_0.9"]]
    if not reached:
        return ""
    by = f", by {len(reached)} of {len(runs.rows)}"
    return f"{interval_of(reached)}{by * (len(reached) < len(runs.rows))}"


MEASURES: dict[str, Callable[..., str]] = {
    "runs": lambda runs: str(len(runs.rows)),
    "seeds": _seeds,
    "steps": lambda runs: f"{max(int(c['step'][-1]) for c in runs.curves()):,}",
    "ksteps": lambda runs: f"{max(int(c['step'][-1]) for c in runs.curves()) / 1000:,.0f}k",
    # Evaluations: the mean over the seeds, and each seed's
    "mean": lambda runs: _mean(_values(runs)),
    "counted": lambda runs: f"{_mean(_values(runs))} ({len(runs.rows)})",
    "each": lambda runs: _list(_values(runs)),
    "episodes": lambda runs: number(fmean(runs.numbers("std"))),
    "iqm": lambda runs: str(interval_of(_values(runs))),
    # Over several tasks
    "overall": lambda runs: str(interquartile_mean(_normalized(runs))),
    "paper": _paper,
    "score": lambda runs, which="last": _mean(_scores(runs, which)),
    "scores": lambda runs, which="last": _list(_scores(runs, which)),
    "target": lambda runs, target: _mean(
        [evaluation["targets"][target]["score"] for evaluation in runs.evaluations()]
    ),
    # Metrics of training: over a share of the end, between steps, at a step, over the whole run
    "last": lambda runs, column, share: _around(_last(runs, column, float(share))),
    "lasts": lambda runs, column, share: _list(_last(runs, column, float(share))),
    "after": lambda runs, column, step: _mean(_tail(runs, column, float(step))),
    "between": lambda runs, column, begin, end: number(
        fmean(_tail(runs, column, float(begin), float(end)))
    ),
    "at": lambda runs, column, step: _mean(_at(runs, column, step)),
    "ats": lambda runs, column, step: _list(_at(runs, column, step)),
    "averages": lambda runs, column: number(fmean(_over(runs, column, np.nanmean))),
    "average": lambda runs, column: _range(_over(runs, column, np.nanmean)),
    "middle": lambda runs, column: _range(_over(runs, column, np.nanmedian)),
    "reaches": lambda runs, column, least: _reaches(runs, column, float(least)),
    # Rows of benchmarks.memory_tasks
    "weights": lambda runs: f"{int(runs.rows[0]['weights']):,}",
    "success": _successes,
    "trained": lambda runs: ", ".join(_thousands(row["steps"]) for row in runs.rows),
    "reached": _reached,
    "reached_by": _reached_by,
    "column": lambda runs, column: _list(runs.numbers(column)),
}
"""What can stand in braces, of the runs of a row."""


def _found(path: str) -> list[float]:
    """The numbers that a path leads to: ``FILE.json / KEY / ...``."""
    name, *keys = (part.strip() for part in path.split(" / "))
    value = _json(name)
    for key in keys:
        value = value[int(key)] if isinstance(value, list) else value[key]
    return [float(one) for one in (value if isinstance(value, list) else [value])]


def _of_benchmark(kind: str, words: str, below: str) -> str:
    if kind == "ratio":  # round by round
        over, under = (_found(f"{below}{part}") for part in words.split(" : "))
        values = [a / b for a, b in zip(over, under, strict=True)]
    else:
        values = _found(f"{below}{words}")
    if kind == "spread":
        middle, *ends = numbers([median(values), min(values), max(values)])
        return f"{middle} ({' to '.join(ends)})"
    return number(median(values))


def measure(text: str, path: str) -> str:
    """Returns what stands for the text in braces, in a row of the runs of a path.

    Raises:
        ValueError: if it is no measure, or there is no such run.
    """
    words, _, of = (part.strip() for part in text.partition("@"))
    of = f"{path}{of[1:]}" if of.startswith("./") else of
    name, _, rest = words.partition(" ")
    if name in ("median", "ratio", "spread"):
        below = f"{path} / " if ".json" in path else ""
        return _of_benchmark(name, rest, below)
    if name == "improvement":
        return _improvement(_runs(path), _runs(of))
    if name not in MEASURES:
        raise ValueError(f"unknown measure {name!r}: choose from {', '.join(MEASURES)}")
    return MEASURES[name](_runs(of or path), *rest.split())


def _improvement(ours: Runs, others: Runs) -> str:
    """The probability of improvement over the tasks that both have."""
    a = _normalized(ours)
    b = _normalized(others, tasks=a)
    return str(probability_of_improvement({task: a[task] for task in a if task in b}, b))


@cache
def _runs(path: str) -> Runs:
    return Runs(path)


def print_table(folder: str, form: str) -> str:
    """Makes a table.

    Args:
        folder: the folder below docs/results that the runs of rows are in.
        form: the lines of its comment.
    """
    if folder.startswith("paper/"):
        return paper.TABLES[folder.removeprefix("paper/")]()
    lines, pattern = [], ""
    for line in filter(None, map(str.strip, form.splitlines())):
        if line.startswith("="):
            pattern = line.removeprefix("=").strip()
            continue
        if line.startswith("|"):
            lines.append(_row(line, "", []))
        else:
            name, _, rest = line.partition(": ")
            if folder.endswith(".json"):
                path = f"{folder} / {name}"
            else:
                path = " ".join(f"{folder}/{p}" if folder else p for p in name.split(" + "))
            lines.append(_row(f"| {pattern} |", path, rest.split("|")))
        if len(lines) == 1:
            lines.append("|" + "---|" * (lines[0].count("|") - 1))
    text = "\n".join(lines) + "\n"
    return text + _FEW if _MARK in text else text


def _row(form: str, path: str, cells: Sequence[str]) -> str:
    """Fills in a row of the runs of a path."""

    for place, cell in enumerate(cells, 1):
        form = form.replace(f"{{{place}}}", cell.strip())
    form = _MEASURE.sub(lambda found: measure(found[1], path), form)
    return re.sub(r"\|  +(?=\|)", "| ", form)


def fill(text: str) -> str:
    """Returns a page with its tables as the data have them."""
    return _TABLE.sub(lambda m: f"{m[1]}{print_table(m[2], m[3])}{m[5]}", text)


def main(arguments: Sequence[str] | None = None) -> None:
    """Writes the tables of all pages, or names the pages that differ."""
    check = "--check" in (sys.argv[1:] if arguments is None else arguments)
    differ = []
    for path in sorted(path for pattern in PAGES for path in ROOT.glob(pattern)):
        text = path.read_text(encoding="utf-8")
        if fill(text) != text:
            differ.append(str(path.relative_to(ROOT)))
            if not check:
                write_text_atomic(path, fill(text))
    if differ:
        print(f"{'differ from their data' if check else 'written'}: {', '.join(differ)}")
    if differ and check:
        sys.exit(1)


if __name__ == "__main__":
    main()
