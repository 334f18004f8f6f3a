"""Runs benchmarks by name: ``python -m benchmarks [NAME ...]``, all of them without a name."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path

BENCHMARKS = [
    "acting",
    "training_step",
    "memory",
    "decision_transformer",
    "history_windows",
    "ppo_cartpole",
]


def main() -> None:
    """Runs the benchmarks, prints their Markdown, and writes it with the numbers as JSON."""
    parser = argparse.ArgumentParser("python -m benchmarks")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(BENCHMARKS)}")
    parser.add_argument("--out", type=Path, help="folder for NAME.md and NAME.json")
    options = parser.parse_args()
    if unknown := set(options.names) - set(BENCHMARKS):
        parser.error(f"unknown benchmark {sorted(unknown)}: choose from {', '.join(BENCHMARKS)}")
    for name in options.names or BENCHMARKS:
        importlib.import_module(f"benchmarks.{name}").main(options.out)


if __name__ == "__main__":
    main()
