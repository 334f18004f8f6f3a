"""Metrics of a run as CSV and TensorBoard."""

from __future__ import annotations

import csv
import io
import shutil
import time
from pathlib import Path

from torchrl.record.loggers.tensorboard import TensorboardLogger

from torchrl_tit.files import write_text_atomic


class Metrics:
    """One row of numbers at a time, in ``metrics.csv`` and in ``tensorboard/``.

    The CSV is the record: its first two columns are ``step`` and ``time`` (seconds since 1970).
    TensorBoard's files are written from it anew when a run is resumed, so that neither holds a row
    of work that was lost.

    Args:
        folder: the run folder.
        columns: names of the numbers, in the CSV's order.
        last_step: rows past this step are dropped.
    """

    def __init__(self, folder: Path, columns: list[str], last_step: int) -> None:
        self.path = folder / "metrics.csv"
        self._columns = ["step", "time", *columns]
        rows = [row for row in read_metrics(self.path) if row["step"] <= last_step]
        write_text_atomic(self.path, self._lines([self._columns]))
        shutil.rmtree(folder / "tensorboard", ignore_errors=True)
        self._tensorboard = TensorboardLogger(exp_name="tensorboard", log_dir=str(folder))
        self._file = self.path.open("a", newline="")
        for row in rows:
            self._write(row)

    def log(self, step: int, **values: float) -> None:
        """Adds a row; NaN stands for a number that does not exist at this step."""
        self._write({"step": step, "time": time.time(), **values})

    def close(self) -> None:
        """Closes the files."""
        self._file.close()
        self._tensorboard.experiment.close()

    def _write(self, row: dict[str, float]) -> None:
        self._file.write(self._lines([[row[column] for column in self._columns]]))
        self._file.flush()
        for name in self._columns[2:]:
            if row[name] == row[name]:  # NaN is not: nothing to draw
                self._tensorboard.experiment.add_scalar(
                    name, row[name], int(row["step"]), walltime=row["time"]
                )

    @staticmethod
    def _lines(rows: list[list[object]] | list[list[str]] | list[list[float]]) -> str:
        buffer = io.StringIO()
        csv.writer(buffer, lineterminator="\n").writerows(rows)
        return buffer.getvalue()


def read_metrics(path: Path) -> list[dict[str, float]]:
    """Reads the complete rows of a ``metrics.csv``; none where there is no file.

    Args:
        path: the file.

    Returns:
        A dict of numbers for each row, ``step`` among them.
    """
    if not path.exists():
        return []
    # A row that a killed process left without its line end is no row.
    complete = [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]
    return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(complete)]
