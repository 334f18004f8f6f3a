"""Metrics of a run as CSV and TensorBoard."""

from __future__ import annotations

import csv
import math
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from torchrl.record.loggers.tensorboard import TensorboardLogger

from torchrl_tit.evaluation_file import MOST_STEPS, is_number
from torchrl_tit.extras import missing
from torchrl_tit.files import naming, write_text_atomic

from .records import to_csv


class Metrics:
    """One row of numbers at a time, in ``metrics.csv`` and in ``tensorboard/``.

    The CSV is the record: its first columns are ``step``, ``time`` (seconds since 1970) and
    ``steps_per_second`` since the row before, or since the start, without pauses.
    TensorBoard's files are rewritten from it when a run is resumed, so that neither holds a row of
    work that was lost.

    Args:
        folder: the run folder.
        columns: names of the numbers, in the CSV's order.
        last_step: rows past this step are dropped.

    Raises:
        ModuleNotFoundError: if TensorBoard is not installed.
    """

    def __init__(self, folder: Path, columns: list[str], last_step: int) -> None:
        if find_spec("tensorboard") is None:  # an extra
            raise ModuleNotFoundError(missing("tensorboard"), name="tensorboard")
        self.path = folder / "metrics.csv"
        self._columns = ["step", "time", "steps_per_second", *columns]
        self._last = (last_step, time.monotonic())
        kept = [row for row in read_metrics(self.path) if row["step"] <= last_step]
        # Written atomically: a process that is killed here loses no row.
        write_text_atomic(self.path, to_csv([self._columns, *map(self._cells, kept)]))
        events = folder / "tensorboard"
        if events.is_symlink():  # its target is not ours
            events.unlink()
        shutil.rmtree(events, ignore_errors=True)
        self._tensorboard = TensorboardLogger(exp_name="tensorboard", log_dir=str(folder))
        for row in kept:
            self._draw(row)
        self._file = self.path.open("a", encoding="utf-8", newline="")

    def log(self, step: int, **values: float) -> dict[str, float]:
        """Adds a row and returns it; NaN means that a number does not exist at this step."""
        before, then = self._last
        self._last = (step, time.monotonic())
        speed = (step - before) / max(self._last[1] - then, 1e-9)
        row = {"step": step, "time": time.time(), "steps_per_second": speed, **values}
        line = to_csv([self._cells(row)])
        with naming(self.path):
            self._file.write(line)
            self._file.flush()
        self._draw(row)
        return row

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Leaves the time in the block out of ``steps_per_second``: no steps are made in it."""
        began = time.monotonic()
        yield
        step, then = self._last
        self._last = (step, then + time.monotonic() - began)

    def sync(self) -> None:
        """Flushes the rows to the disk."""
        with naming(self.path):
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Closes the files."""
        self._file.close()
        self._tensorboard.experiment.close()

    def _cells(self, row: dict[str, float]) -> list[float]:
        try:
            return [int(row["step"]), *(float(row[column]) for column in self._columns[1:])]
        except KeyError as error:
            raise ValueError(
                f"{self.path} has no column {error}: it belongs to another run"
            ) from error

    def _draw(self, row: dict[str, float]) -> None:
        for name in self._columns[2:]:
            if not math.isnan(row[name]):
                self._tensorboard.experiment.add_scalar(
                    name, row[name], int(row["step"]), walltime=row["time"]
                )


def read_metrics(path: Path) -> list[dict[str, float]]:
    """Reads the complete rows of a ``metrics.csv``; none if there is no file.

    Args:
        path: the file.

    Returns:
        A dict of numbers for each row, ``step`` among them.

    Raises:
        ValueError: if a row is damaged.
    """
    return parse_metrics(path.read_bytes(), path) if path.exists() else []


def parse_metrics(content: bytes | None, path: Path) -> list[dict[str, float]]:
    """Reads the complete rows of the content of a ``metrics.csv``; none if there is none.

    Args:
        content: the content.
        path: where it is from, for messages.

    Raises:
        ValueError: if a row is damaged.
    """
    rows: list[dict[str, float]] = []
    try:
        # A row without a line end was left by a killed process and is skipped.
        lines = (content or b"").decode().splitlines(keepends=True)
        for cells in csv.DictReader(line for line in lines if line.endswith("\n")):
            row = {name: float(value) for name, value in cells.items()}
            before = rows[-1]["step"] if rows else -1
            if not (row["step"].is_integer() and before < row["step"] <= MOST_STEPS):
                raise ValueError("its step is not a whole number above that of the row before")
            # NaN and infinity stand for numbers that do not exist, and are not drawn.
            if wrong := [name for name, x in row.items() if math.isfinite(x) and not is_number(x)]:
                raise ValueError(f"its {wrong[0]} is {row[wrong[0]]}")
            rows.append(row)
    except (csv.Error, LookupError, TypeError, ValueError) as error:
        last = f"step {rows[-1]['step']:.0f}" if rows else "its beginning"
        raise ValueError(f"{path} has a damaged row after {last} ({error})") from error
    return rows
