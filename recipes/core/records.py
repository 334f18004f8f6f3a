"""Records of runs: a table of many runs in a folder, small enough to lie beside the code.

    records.csv       a row for each run, see :data:`COLUMNS`
    recipes.json.xz   the runs' recipes without their seeds, each once
    curves.csv.xz     the rows of the runs' metrics, below one another

What is left out: metrics keep four significant digits and returns of single episodes six, and the
metrics in :data:`LEFT_OUT` and checkpoints are not kept.
"""

from __future__ import annotations

import csv
import io
import json
import lzma
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Any

from torchrl_tit.files import write_bytes_atomic, write_text_atomic

TABLE, RECIPES, CURVES = "records.csv", "recipes.json.xz", "curves.csv.xz"

COLUMNS = (
    "run",  # its path below the folder
    "recipe",
    "changes",  # the settings that differed from the recipe of that name when it was recorded
    "seed",
    "settings",  # the key of its recipe in recipes.json.xz
    "ended",  # UTC
    "commit",  # that has its code and its full record
    "versions",
    "steps",
    "mean",
    "std",
    "returns",
    "evaluation",  # the other entries of evaluation.json
    "earlier_lengths",
)

LEFT_OUT = ("time", "learning_rate", "loss_objective", "loss_critic", "loss_entropy")
"""Metrics that are not kept."""

_DAMAGE = (
    csv.Error,
    EOFError,
    LookupError,
    OSError,
    RecursionError,
    TypeError,
    ValueError,
    lzma.LZMAError,
)
"""How reading a file of others can fail."""
_MOST_BYTES = 2**26  # far more than any table unpacks to

OF_EVALUATION = ("steps", "mean", "std", "returns")
"""The entries of evaluation.json that have a column."""


@dataclass(frozen=True)
class Record:
    """A run as a table holds it.

    Args:
        row: its row, by the names of :data:`COLUMNS`.
        recipe: its recipe without the seed.
        curve: its rows of ``curves.csv.xz`` as the text of a ``metrics.csv``.
    """

    row: dict[str, str]
    recipe: dict[str, Any]
    curve: str

    @property
    def key(self) -> tuple[str, ...]:
        """What no two runs have in common, whatever their names."""
        return tuple(self.row[column] for column in ("settings", "seed", "ended", "steps"))

    def is_beginning_of(self, other: Record) -> bool:
        """Whether it is the same run before it had ended, or was evaluated."""
        same = all(self.row[x] == other.row[x] for x in ("settings", "seed", "versions"))
        more = other.curve != self.curve or (not self.row["steps"] and bool(other.row["steps"]))
        return same and other.curve.startswith(self.curve) and more


class Records:
    """The table of runs in a folder.

    Args:
        folder: the folder; without a table in it, there are no runs.

    Raises:
        ValueError: if the table is damaged.

    Example:
        >>> records = Records("docs/results/hopper")
        >>> records.below("tried")[0]
        'tried/critic-0.02'
        >>> records.read("tried/critic-0.02", "metrics.csv")[:21]
        b'step,return_mean,epis'
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.rows: dict[str, dict[str, str]] = {}
        path = self.folder / TABLE
        if path.is_file():
            with _reading(path), path.open(newline="", encoding="utf-8") as file:
                rows = list(csv.DictReader(file))
                if any(set(row) != set(COLUMNS) or None in row.values() for row in rows):
                    raise ValueError(f"expected the columns {', '.join(COLUMNS)}")
            self.rows = {row["run"]: row for row in rows}

    def below(self, path: str) -> list[str]:
        """Names the run of a path, or all runs below it, in the table's order."""
        return [run for run in self.rows if PurePosixPath(run).is_relative_to(path)]

    def read(self, run: str, name: str) -> bytes | None:
        """Returns a file of a run's folder as far as the table holds it.

        Args:
            run: the run's name.
            name: recipe.json, versions.json, evaluation.json, earlier_lengths.json or metrics.csv.

        Raises:
            ValueError: if the table's files are damaged.
        """
        row = self.rows[run]
        if name == "metrics.csv":
            text = self._curves.get(run, "")
        elif name == "recipe.json":
            recipe = self._recipe(row)
            with _reading(self.folder / TABLE):
                text = json.dumps({**recipe, "seed": int(row["seed"])}, indent=2) + "\n"
        elif name == "evaluation.json":
            with _reading(self.folder / TABLE):
                text = _evaluation(row)
        else:
            text = row.get(name.removesuffix(".json"), "")
        return text.encode() if text else None

    def records(self) -> dict[str, Record]:
        """Returns all runs by name."""
        return {
            run: Record(row, self._recipe(row), self._curves.get(run, ""))
            for run, row in self.rows.items()
        }

    def add(self, records: Mapping[str, Record]) -> None:
        """Adds runs and writes the table; a process that is killed leaves the table as it was.

        A run whose beginning the table holds under the same name is replaced.

        Args:
            records: the runs by name.

        Raises:
            ValueError: if the table holds one of them already.
        """
        found = self.records()
        for run, record in records.items():
            if run in found and found[run].is_beginning_of(record):
                del found[run]
        known = {record.key: run for run, record in found.items()}
        for run, record in records.items():
            same = run if run in found else known.setdefault(record.key, run)
            if run in found or same != run:
                raise ValueError(
                    f"{self.folder} holds {run} already, as {same}: leave it out, or give another "
                    "run another name with --under"
                )
            found[run] = record
        found = {run: found[run] for run in sorted(found, key=PurePosixPath)}
        self.folder.mkdir(parents=True, exist_ok=True)
        recipes = {record.row["settings"]: record.recipe for record in found.values()}
        _write_xz(self.folder / RECIPES, json.dumps(recipes, indent=1) + "\n")
        _write_xz(self.folder / CURVES, _join({run: one.curve for run, one in found.items()}))
        # The table comes last: what the other files hold beyond it is not read.
        rows = [[one.row[column] for column in COLUMNS] for one in found.values()]
        write_text_atomic(self.folder / TABLE, to_csv([COLUMNS, *rows]))
        self.rows = {run: record.row for run, record in found.items()}
        self.__dict__.pop("_recipes", None)
        self.__dict__.pop("_curves", None)

    def _recipe(self, row: dict[str, str]) -> dict[str, Any]:
        with _reading(self.folder / RECIPES):
            if row["settings"] not in self._recipes:
                raise ValueError(f"it lacks the recipe of {row['run']}")
            return dict(self._recipes[row["settings"]])

    @cached_property
    def _recipes(self) -> dict[str, Any]:
        return dict(json.loads(_read_xz(self.folder / RECIPES)))

    @cached_property
    def _curves(self) -> dict[str, str]:
        path = self.folder / CURVES
        with _reading(path):
            rows = csv.reader(io.StringIO(_read_xz(path)))
            header = next(rows, [])
            curves = {}
            for run, group in groupby(rows, key=lambda cells: cells[0]):
                lines = list(group)
                # Empty is a metric that the run does not have; one without a value at a step is
                # nan.
                kept = [i for i, cell in enumerate(lines[0]) if i and cell]
                curves[run] = to_csv([[line[i] for i in kept] for line in [header, *lines]])
            return curves


def find_records(path: Path) -> tuple[Records, str] | None:
    """Finds the table of runs that a path leads into.

    Args:
        path: the path of a run, or of several, below a table's folder, where nothing has that path.

    Returns:
        The table, and the path below its folder; None if there is no table.

    Example:
        >>> records, below = find_records(Path("docs/results/hopper/tried"))
        >>> str(records.folder), below
        ('docs/results/hopper', 'tried')
    """
    if path.exists():
        return None
    for folder in path.parents:
        if (folder / TABLE).is_file():
            return Records(folder), path.relative_to(folder).as_posix()
    return None


def _evaluation(row: dict[str, str]) -> str:
    if not row["steps"]:
        return ""
    known = {name: json.loads(row[name]) for name in OF_EVALUATION if row[name]}
    others = json.loads(row["evaluation"]) if row["evaluation"] else {}
    return json.dumps({**known, **others})


def _join(curves: Mapping[str, str]) -> str:
    """Writes curves below one another, with an empty cell where a run lacks a metric."""
    tables = {run: list(csv.DictReader(io.StringIO(curve))) for run, curve in curves.items()}
    names = dict.fromkeys(name for rows in tables.values() for row in rows[:1] for name in row)
    lines = [
        [run, *(row.get(name, "") for name in names)]
        for run, rows in tables.items()
        for row in rows
    ]
    return to_csv([["run", *names], *lines])


def to_csv(rows: Iterable[Iterable[Any]]) -> str:
    """Writes rows as CSV."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    return buffer.getvalue()


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Raises ValueError, which names the file, whatever is wrong with its content."""
    try:
        yield
    except _DAMAGE as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def _read_xz(path: Path) -> str:
    with lzma.open(path) as file:
        content = file.read(_MOST_BYTES + 1)
    if len(content) > _MOST_BYTES:
        raise ValueError(f"it unpacks to more than the {_MOST_BYTES} bytes that it may have")
    return content.decode()


def _write_xz(path: Path, text: str) -> None:
    write_bytes_atomic(path, lzma.compress(text.encode(), preset=9))
