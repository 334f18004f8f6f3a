"""What benchmarks share: programs that take turns, tables with their spread, and result files."""

from __future__ import annotations

import argparse
import csv
import datetime
import importlib.metadata
import json
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch

from recipes.core.numbers import number
from recipes.core.numbers import numbers as format_all
from torchrl_tit.files import write_text_atomic

_PACKAGES = ["torch", "torchrl", "tensordict", "gymnasium", "stable-baselines3", "transformers"]
_BESIDE = ["d3rlpy"]


def milliseconds(step: Callable[[], Any], seconds: float) -> float:
    """Returns the milliseconds that a step takes, measured over at least some seconds.

    On a CPU it is processor time, which other programs on the machine hardly affect. On another
    default device it is time on the clock, until the device has done all that it was given.
    """
    device = torch.get_default_device()
    count, start = 0, clock(device)
    while count == 0 or clock(device) - start < seconds:
        step()
        count += 1
    return 1000 * (clock(device) - start) / count


def clock(device: torch.device) -> float:
    """Returns processor time on a CPU, and the time at which another device has done its work."""
    if device.type == "cpu":
        return time.process_time()
    torch.accelerator.synchronize()
    return time.perf_counter()


def take_turns(
    steps: Mapping[str, Callable[[], Any]], rounds: int, seconds: float
) -> dict[str, list[float]]:
    """Measures the milliseconds of each program's step in each round, alternating, warmed up."""
    for step in steps.values():
        step()
    times: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(rounds):
        for name, step in steps.items():
            times[name].append(milliseconds(step, seconds))
    return times


def ratios(one: Sequence[float], other: Sequence[float]) -> list[float]:
    """Returns quotients round by round."""
    return [a / b for a, b in zip(one, other, strict=True)]


@contextmanager
def empty_compile_cache() -> Iterator[None]:
    """Compiles everything anew."""
    with (
        tempfile.TemporaryDirectory() as cache,
        patch.dict(os.environ, TORCHINDUCTOR_CACHE_DIR=cache),
    ):
        yield


def spread(values: Sequence[float]) -> str:
    """Formats the median and the range of repeats, as ``300 (280 to 310)``."""
    return "{} ({} to {})".format(
        *format_all([statistics.median(values), min(values), max(values)])
    )


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Makes a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines) + "\n"


def summary(numbers: Mapping[str, Any]) -> str:
    """Makes a Markdown table of nested numbers; lists of repeats become medians and ranges.

    Args:
        numbers: rows by their names, or a list of rows under "rows".
    """
    rows = numbers.get("rows") or [{"": name, **_cells(row)} for name, row in numbers.items()]
    flat = [_cells(row) for row in rows]
    header = list(dict.fromkeys(name for row in flat for name in row))
    return table(header, [[row.get(name, "") for name in header] for row in flat])


def _cells(numbers: Any, path: str = "") -> dict[str, object]:
    """Nested numbers by their paths."""
    if isinstance(numbers, Mapping):
        below = [_cells(part, f"{path} / {name}".strip(" /")) for name, part in numbers.items()]
        return {name: cell for part in below for name, cell in part.items()}
    if isinstance(numbers, float):
        return {path: number(numbers)}
    return {path: spread(numbers) if isinstance(numbers, list | tuple) else numbers}


def folder(text: str) -> Path:
    """Reads the argument of ``--out``: a folder, which need not exist yet."""
    path = Path(text)
    if path.exists() and not path.is_dir():
        raise argparse.ArgumentTypeError(f"{path} is a file: name a folder")
    return path


def publish(
    name: str,
    markdown: str,
    numbers: dict[str, Any],
    out: Path | None,
    command: str,
) -> None:
    """Prints the Markdown; writes Markdown and numbers, with date and versions, to a folder."""
    facts = {
        "date": datetime.date.today().isoformat(),
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "device": str(torch.get_default_device()),
        **{
            package: importlib.metadata.version(package)
            for package in [*_PACKAGES, *_BESIDE]
            if find_spec(package.replace("-", "_"))
        },
    }
    if torch.get_default_device().type != "cpu":
        facts["peak_memory_bytes"] = str(torch.accelerator.max_memory_allocated())
    listed = ", ".join(f"{key} {value}" for key, value in facts.items())
    markdown += f"\nMeasured with `{command}`: {listed}.\n"
    print(markdown)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_text_atomic(out / f"{name}.md", markdown)
        record = {"command": command, "conditions": facts, **numbers}
        write_text_atomic(out / f"{name}.json", json.dumps(record, indent=2) + "\n")


def read_rows(path: Path) -> list[dict[str, str]]:
    """Reads the rows of a CSV file; none if there is no file."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


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
    done = [tuple(row.values()) for row in read_rows(path)]
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(",".join(columns) + "\n", encoding="utf-8")
    for run in runs:
        if any(row[: len(run)] == tuple(map(str, run)) for row in done):
            continue
        row = measure(*run)
        with path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerow(row)
        print(*row, flush=True)
