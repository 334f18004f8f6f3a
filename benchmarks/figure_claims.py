"""The paper's claims about its pictures as numbers: ``python -m benchmarks.figure_claims RUN ...``.

The runs must be trained on images, with several seeds of each recipe; see docs/analysis.md.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from benchmarks.report import publish
from recipes.results.experiments import group_runs
from recipes.results.figure_claims import FigureClaims, measure_figure_claims, to_markdown
from recipes.run import Run


def main(arguments: list[str] | None = None) -> None:
    """Measures runs, prints Markdown, and writes it and the numbers as JSON."""
    parser = argparse.ArgumentParser("python -m benchmarks.figure_claims")
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="folders of trained runs")
    parser.add_argument("--steps", type=int, default=500, help="steps of each run to look at")
    parser.add_argument("--seed", type=int, help="of the first episode; default: the evaluation's")
    parser.add_argument(
        "--background",
        choices=["place", "colour"],
        default="place",
        help="what is no object: the median at each place, or each frame's most common colour",
    )
    parser.add_argument("--target", choices=["action", "value"], default="action")
    parser.add_argument(
        "--out", type=Path, help="folder for figure_claims.md and figure_claims.json"
    )
    options = parser.parse_args(arguments)
    if options.out is not None and options.out.exists() and not options.out.is_dir():
        parser.error(f"--out {options.out} is a file: name a folder")
    try:
        experiments = group_runs(Run.open(folder) for folder in options.runs)
        groups: dict[str, list[FigureClaims]] = {
            experiment.label: [
                measure_figure_claims(
                    run,
                    steps=options.steps,
                    seed=options.seed,
                    background=options.background,
                    target=options.target,
                )
                for run in experiment.runs
            ]
            for experiment in experiments
        }
    except (ValueError, OSError, RuntimeError) as error:
        parser.error(" ".join(str(error).split()))
    settings = {
        "steps": options.steps,
        "background": options.background,
        "target": options.target,
        "runs": {name: [asdict(claims) for claims in found] for name, found in groups.items()},
    }
    command = (
        f"python -m benchmarks.figure_claims RUN ... --steps {options.steps} "
        f"--background {options.background} --target {options.target}"
    )
    publish("figure_claims", to_markdown(groups), settings, options.out, command)


if __name__ == "__main__":
    main()
