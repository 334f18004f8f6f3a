"""Records finished runs in a table of runs."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

from ..records import Record, Records, make_record
from ..registry import RECIPES
from ..run import Run
from .experiments import changes_of, find_runs, read_metrics


def record_runs(
    folders: Iterable[Path], out: Path, *, under: str = "", commit: str = ""
) -> list[str]:
    """Adds runs to the table of runs in a folder, which it begins if there is none.

    A run is named as its path below the folder that is given, or as that folder if it is a run.
    Beside ``metrics.csv``, the columns of other CSV files of its folder with a column ``step`` are
    recorded, such as the successes of ``benchmarks.memory_tasks``.

    Args:
        folders: run folders, or folders with run folders somewhere below.
        out: the folder of the table.
        under: the path in the table under which the runs are named.
        commit: the commit of the code that the runs had, if known.

    Returns:
        The names of the runs in the table.

    Raises:
        ValueError: if a folder holds no run, a run has no metrics or is damaged, or the table has
            it already.
    """
    records: dict[str, Record] = {}
    for folder in folders:
        for run in find_runs([folder]):
            below = run.folder.relative_to(folder).as_posix()
            name = str(PurePosixPath(under, folder.resolve().name if below == "." else below))
            if name in records:
                raise ValueError(
                    f"two of the runs would be named {name}: record {folder} by itself, with "
                    "another path in --under"
                )
            records[name] = _record(name, run, commit)
    Records(out).add(records)
    return list(records)


def _record(name: str, run: Run, commit: str) -> Record:
    metrics = _metrics(run)
    if not metrics:
        raise ValueError(f"{run.folder} has no metrics yet: train it first, or leave it out")
    named = dict(RECIPES).get(run.recipe.name)
    return make_record(
        name,
        _read(run, "recipe.json"),
        changes_of(named, run.recipe) if named else {},
        _read(run, "versions.json"),
        run.read_evaluation(),
        run.earlier_lengths(),
        metrics,
        commit,
    )


def _read(run: Run, name: str) -> dict[str, Any]:
    content = run.read(name)
    try:
        return dict(json.loads(content)) if content else {}
    except (ValueError, TypeError) as error:
        raise ValueError(f"{run.folder / name} is damaged: {error}") from error


def _metrics(run: Run) -> list[dict[str, float]]:
    """The rows of a run's metrics, with the columns of its other files beside them."""
    rows = read_metrics(run)
    for path in sorted(run.folder.glob("*.csv")):
        others: dict[float, dict[str, str]] = {}
        if path.name != "metrics.csv":
            for other in csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))):
                if "step" not in other:
                    break
                others[float(other["step"])] = other
        for row in rows if others else ():
            for column in next(iter(others.values())):
                if column not in row:
                    row[column] = float(others.get(row["step"], {}).get(column, "nan"))
    return rows
