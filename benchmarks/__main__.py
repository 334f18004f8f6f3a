"""Runs benchmarks by name, or all of them without a name: ``python -m benchmarks [NAME ...]``."""

from __future__ import annotations

import argparse
import importlib

import torch

from .measuring import folder, publish, summary

BENCHMARKS = [
    "acting",
    "segments",
    "window_tables",
    "memories",
    "offline",
    "decision_transformer",
    "history_windows",
    "export",
    "ppo_cartpole",
    "off_policy",
]


def main(arguments: list[str] | None = None) -> None:
    """Runs benchmarks, prints their numbers, and writes them as JSON."""
    parser = argparse.ArgumentParser("python -m benchmarks")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(BENCHMARKS)}")
    parser.add_argument("--out", type=folder, help="folder for NAME.md and NAME.json")
    options = parser.parse_args(arguments)
    if unknown := set(options.names) - set(BENCHMARKS):
        parser.error(f"unknown benchmark {sorted(unknown)}: choose from {', '.join(BENCHMARKS)}")
    for name in options.names or BENCHMARKS:
        module = importlib.import_module(f"benchmarks.{name}")
        torch.set_num_threads(1)
        torch.manual_seed(0)
        numbers = module.main()
        markdown = f"# {name}\n\n{module.__doc__}\n{summary(numbers)}"
        publish(name, markdown, numbers, options.out, f"python -m benchmarks {name}")


if __name__ == "__main__":
    main()
