"""Attention of agents to a cue when they decide: ``python -m benchmarks.cue_attention RUN ...``.

The runs must be trained on MiniGrid-Memory, such as ppo/memory-s7/enhanced-tit, or on a task whose
first observation is the cue, such as ppo/tmaze-10/enhanced-tit.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.report import publish
from recipes.results.cue_attention import (
    Decision,
    measure_decisions,
    plot_decisions,
    to_markdown,
)
from recipes.results.plot import save_figure
from recipes.run import Run


def main(arguments: list[str] | None = None) -> None:
    """Measures runs, prints Markdown, and writes it, the numbers as JSON, and a picture."""
    parser = argparse.ArgumentParser("python -m benchmarks.cue_attention")
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folders of trained runs")
    parser.add_argument("--episodes", type=int, default=100, help="episodes of each run")
    parser.add_argument("--seed", type=int, help="of the first episode; default: the evaluation's")
    parser.add_argument("--out", type=Path, help="folder for cue_attention.md, .json and .png")
    options = parser.parse_args(arguments)
    if options.out is not None and options.out.exists() and not options.out.is_dir():
        parser.error(f"--out {options.out} is a file: name a folder")
    try:
        groups: dict[str, list[Decision]] = {}
        for run in map(Run.open, options.runs):
            name = f"{run.recipe.name}, seed {run.recipe.seed}"
            name += f" ({run.folder})" if name in groups else ""
            groups[name] = measure_decisions(run, episodes=options.episodes, seed=options.seed)
    except (ValueError, OSError, RuntimeError) as error:
        parser.error(" ".join(str(error).split()))
    numbers = {
        name: [{"right": one.right, "shares": one.shares, "even": one.even} for one in found]
        for name, found in groups.items()
    }
    command = f"python -m benchmarks.cue_attention RUN ... --episodes {options.episodes}"
    publish("cue_attention", to_markdown(groups), {"runs": numbers}, options.out, command)
    if options.out is not None:
        save_figure(plot_decisions(groups), options.out / "cue_attention.png")


if __name__ == "__main__":
    main()
