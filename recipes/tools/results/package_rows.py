"""The tables of numbers that come with this package."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from importlib import resources


def read_rows(file: str) -> Iterator[dict[str, str]]:
    """Reads a CSV file that lies beside this module."""
    text = resources.files(__package__).joinpath(file).read_text(encoding="utf-8")
    yield from csv.DictReader(io.StringIO(text))
