"""Times of our network, eager and compiled, and the straightforward one, for JSON and tables."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

from .report import spread

HEADER = ["dtype", "ours", "ours, compiled", "straightforward", "ratio", "ratio, compiled"]


def record(times: Mapping[str, list[float]]) -> dict[str, Any]:
    """Milliseconds of each round by name, and ratios to "straightforward" in each round."""
    row: dict[str, Any] = {}
    for name, values in times.items():
        row[f"{name}_ms"] = values
        if name != "straightforward":
            ratios = [b / a for a, b in zip(values, times["straightforward"], strict=True)]
            row |= {f"{name}_ratios": ratios, f"{name}_median_ratio": statistics.median(ratios)}
    return row


def cells(row: dict[str, Any], *, ms_digits: int, ratio_digits: int) -> list[str]:
    """Makes the cells of a table row under ``HEADER``."""
    compiled = "compiled_ms" in row
    return [
        row["dtype"],
        spread(row["ours_ms"], ms_digits),
        spread(row["compiled_ms"], ms_digits) if compiled else "",
        spread(row["straightforward_ms"], ms_digits),
        spread(row["ours_ratios"], ratio_digits),
        spread(row["compiled_ratios"], ratio_digits) if compiled else "",
    ]
