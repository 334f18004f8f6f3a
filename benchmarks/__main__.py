"""Runs benchmarks by name, or all of them without a name: ``python -m benchmarks [NAME ...]``."""

from __future__ import annotations

import argparse
import importlib
import json
from pathlib import Path

from torchrl_tit.files import write_text_atomic

BENCHMARKS = [
    "acting",
    "training_step",
    "segments",
    "memory",
    "cql",
    "cql_images",
    "rollouts",
    "decision_transformer",
    "history_windows",
    "export",
    "ppo_cartpole",
]


def main() -> None:
    """Runs benchmarks, prints their Markdown, and writes it and the numbers as JSON.

    If all benchmarks run, their results are collected in benchmarks.md and benchmarks.json.
    """
    parser = argparse.ArgumentParser("python -m benchmarks")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(BENCHMARKS)}")
    parser.add_argument("--out", type=Path, help="folder for NAME.md and NAME.json")
    options = parser.parse_args()
    if unknown := set(options.names) - set(BENCHMARKS):
        parser.error(f"unknown benchmark {sorted(unknown)}: choose from {', '.join(BENCHMARKS)}")
    names = options.names or BENCHMARKS
    for name in names:
        importlib.import_module(f"benchmarks.{name}").main(options.out)
    if options.out is not None and not options.names:
        gather(options.out)


def gather(out: Path) -> None:
    """Joins the results of all benchmarks in a folder: benchmarks.md and benchmarks.json."""
    texts = [(out / f"{name}.md").read_text(encoding="utf-8") for name in BENCHMARKS]
    numbers = {name: json.loads((out / f"{name}.json").read_bytes()) for name in BENCHMARKS}
    write_text_atomic(out / "benchmarks.md", "\n".join(texts))
    write_text_atomic(out / "benchmarks.json", json.dumps(numbers, indent=2) + "\n")


if __name__ == "__main__":
    main()
