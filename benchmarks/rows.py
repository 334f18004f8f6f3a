"""Results that cost hours: a CSV with a row a run, written as each run ends."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path


def add_missing_rows(
    path: Path,
    columns: Sequence[str],
    runs: Iterable[tuple[object, ...]],
    measure: Callable[..., list[object]],
) -> None:
    """Measures the runs that have no row yet, and adds and prints a row as soon as one ends.

    Args:
        path: the CSV, created if it is not there.
        columns: its header.
        runs: what names each run: the values of the first columns.
        measure: returns the whole row of a run, given these values.
    """
    done = set()
    if path.exists():
        with path.open(newline="", encoding="utf-8") as file:
            done = {tuple(row) for row in csv.reader(file)}
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(",".join(columns) + "\n", encoding="utf-8")
    for run in runs:
        names = tuple(map(str, run))
        if any(row[: len(names)] == names for row in done):
            continue
        row = measure(*run)
        with path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerow(row)
        print(*row, flush=True)
