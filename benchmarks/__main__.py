"""Runs benchmarks by name, or all of them without a name: ``python -m benchmarks [NAME ...]``."""

from __future__ import annotations

import argparse
import importlib
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch

from recipes.core.algorithm import torch_device

from .measuring import folder, publish, summary

BENCHMARKS = [
    "acting",
    "segments",
    "window_tables",
    "memories",
    "sliding",
    "offline",
    "decision_transformer",
    "history_windows",
    "export",
    "ppo_cartpole",
    "ppo_pong",
    "off_policy",
]
ON_DEVICE = ["acting", "segments", "memories", "sliding", "ppo_pong"]
"""The benchmarks that can run on another device than the CPU."""


def main(arguments: list[str] | None = None) -> None:
    """Runs benchmarks, prints their numbers, and writes them as JSON."""
    parser = argparse.ArgumentParser("python -m benchmarks")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(BENCHMARKS)}")
    parser.add_argument("--out", type=folder, help="folder for NAME.md and NAME.json")
    parser.add_argument(
        "--device", default="cpu", help=f"device of PyTorch's, for {', '.join(ON_DEVICE)}"
    )
    options = parser.parse_args(arguments)
    try:
        device = torch_device(options.device)
    except ValueError as error:
        parser.error(str(error))
    if unknown := set(options.names) - set(BENCHMARKS):
        parser.error(f"unknown benchmark {sorted(unknown)}: choose from {', '.join(BENCHMARKS)}")
    on_cpu = device.type == "cpu"
    names = options.names or (BENCHMARKS if on_cpu else ON_DEVICE)
    if not on_cpu and (others := set(names) - set(ON_DEVICE)):
        parser.error(f"{sorted(others)} run on the CPU only: leave out --device")
    # The CPU as a context would stand in the way of torch.compile.
    context: AbstractContextManager[Any] = nullcontext() if on_cpu else device
    where = "" if on_cpu else f" --device {device}"
    for name in names:
        module = importlib.import_module(f"benchmarks.{name}")
        torch.set_num_threads(1)
        torch.manual_seed(0)
        with context:  # all tensors are made there
            numbers = module.main()
            markdown = f"# {name}\n\n{module.__doc__}\n{summary(numbers)}"
            publish(name, markdown, numbers, options.out, f"python -m benchmarks {name}{where}")


if __name__ == "__main__":
    main()
