"""Records finished runs in a table of runs."""

from __future__ import annotations

import csv
import datetime
import hashlib
import io
import json
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any

from ...core.records import COLUMNS, LEFT_OUT, OF_EVALUATION, Record, Records, to_csv
from ...core.registry import RECIPES
from ...core.run import Run, locked
from .experiments import changes_of, find_runs, read_metrics


def record_runs(
    folders: Iterable[Path], out: Path, *, under: str = "", commit: str = ""
) -> list[str]:
    """Adds runs to the table of runs in a folder, which it begins if there is none.

    A run that was recorded before it had ended is replaced. A run is named as its path below the
    folder that is given, or as that folder if it is a run.
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
        ValueError: if a folder holds no run, a run has no metrics or is damaged, the table has it
            already or its folder holds the run, or ``under`` leads out of it.
        RuntimeError: if another process is adding runs.
    """
    records: dict[str, Record] = {}
    if PurePosixPath(under).is_absolute() or ".." in PurePosixPath(under).parts:
        raise ValueError(f"--under {under} must be a path below {out}, such as screening")
    for folder in folders:
        for run in find_runs([folder]):
            inside, outside = run.folder.resolve(), out.resolve()
            if inside in (outside, *outside.parents) or outside in inside.parents:
                raise ValueError(
                    f"--out {out} holds the run {run.folder} or lies in it, so that it would count "
                    "twice: name another folder"
                )
            below = run.folder.relative_to(folder).as_posix()
            name = str(PurePosixPath(under, folder.resolve().name if below == "." else below))
            if name in records:
                raise ValueError(
                    f"two of the runs would be named {name}: record {folder} by itself, with "
                    "another path in --under"
                )
            records[name] = _record(name, run, commit)
    out.mkdir(parents=True, exist_ok=True)
    with locked(out):
        Records(out).add(records)
    return list(records)


def _record(name: str, run: Run, commit: str) -> Record:
    metrics = _metrics(run)
    if not metrics:
        raise ValueError(
            f"{run.folder} has no metrics yet: train it first, for more steps than its "
            "log_interval, or leave it out"
        )
    named = RECIPES.get(run.recipe.name)
    changes = changes_of(named, run.recipe) if named else {}
    changes |= {"initial_weights": run.initial_weights} if run.initial_weights else {}
    recipe, found = _read(run, "recipe.json"), run.read_evaluation() or {}
    settings = {field: value for field, value in recipe.items() if field != "seed"}
    row = {
        "run": name,
        "recipe": run.recipe.name,
        "changes": _dumps(changes),
        "seed": str(run.recipe.seed),
        "settings": hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:12],
        "ended": _ended(metrics),
        "commit": commit,
        "versions": _dumps(_read(run, "versions.json")),
        "earlier_lengths": _dumps(run.earlier_lengths()),
    }
    if "returns" in found:
        found["returns"] = [float(f"{value:.6g}") for value in found["returns"]]
    row |= {entry: _dumps(found.pop(entry)) for entry in OF_EVALUATION if entry in found}
    row["evaluation"] = _dumps(found)
    columns = [column for column in metrics[0] if column not in LEFT_OUT and column != "step"]
    lines = [[f"{one['step']:.0f}", *(f"{one[x]:.4g}" for x in columns)] for one in metrics]
    curve = to_csv([["step", *columns], *lines])
    return Record({column: row.get(column, "") for column in COLUMNS}, settings, curve)


def _ended(metrics: list[dict[str, float]]) -> str:
    """The UTC time of the last row, if it is known."""
    if "time" not in metrics[-1]:
        return ""
    ended = datetime.datetime.fromtimestamp(metrics[-1]["time"], datetime.UTC)
    return ended.strftime("%Y-%m-%dT%H:%M:%S")


def _dumps(value: Any) -> str:
    """Writes JSON; nothing for an empty list or object."""
    return "" if value in ({}, []) else json.dumps(value, separators=(",", ":"))


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
