"""Measured numbers as Markdown and JSON."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import os
import platform
import statistics
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchrl_tit.files import write_text_atomic

_PACKAGES = ["torch", "torchrl", "tensordict", "gymnasium", "stable-baselines3", "transformers"]
_BESIDE = ["d3rlpy"]


def spread(values: Sequence[float], digits: int = 0) -> str:
    """Formats the median and the range of repeats, as ``300 (280 to 310)``."""
    low, middle, high = min(values), statistics.median(values), max(values)
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Makes a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines) + "\n"


def conditions() -> dict[str, Any]:
    """Returns the date, machine and versions of a measurement."""
    return {
        "date": datetime.date.today().isoformat(),
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        **{
            package: importlib.metadata.version(package)
            for package in [*_PACKAGES, *_BESIDE]
            if find_spec(package.replace("-", "_"))
        },
    }


def publish(
    name: str,
    markdown: str,
    numbers: dict[str, Any],
    out: Path | None,
    command: str | None = None,
) -> None:
    """Prints the Markdown; writes Markdown and numbers if a folder is given."""
    facts = conditions()
    command = command or f"python -m benchmarks {name}"
    listed = ", ".join(f"{key} {value}" for key, value in facts.items())
    markdown += f"\nMeasured with `{command}`: {listed}.\n"
    print(markdown)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        write_text_atomic(out / f"{name}.md", markdown)
        record = {"command": command, "conditions": facts, **numbers}
        write_text_atomic(out / f"{name}.json", json.dumps(record, indent=2) + "\n")
