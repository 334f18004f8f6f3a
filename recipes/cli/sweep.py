"""`sweep` and `tune`: many runs at once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from torchrl_tit.settings.numbers import Copies

from ..core.numbers import number
from .arguments import Parser, check_numbers, fail, note, option, say

# What needs PyTorch or an extra is imported once the arguments are read: help is fast.


def sweep(arguments: list[str]) -> None:
    """Trains recipes with seeds."""
    parser = Parser("sweep", "Train many recipes and seeds at once; the same command resumes them.")
    parser.add_argument(
        "names",
        nargs="+",
        help="names of recipes, patterns such as 'ppo/*/mlp', JSON files with a recipe, or Python "
        "files with recipes",
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", default=[0], help="of each recipe; default: 0"
    )
    parser.add_argument(
        "--workers",
        type=int,
        help="runs at a time, each in a process; default: 1, on Ray as many as it has room for",
    )
    parser.add_argument(
        "--ray", metavar="ADDRESS", help="run on a Ray cluster: auto, HOST:PORT or ray://HOST:PORT"
    )
    parser.add_argument(
        "--wandb", metavar="PROJECT", help="project of Weights & Biases that metrics are sent to"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("runs/sweep"),
        help="folder of the runs; default: %(default)s",
    )
    options = parser.parse_args(arguments)
    check_numbers(options, workers=Copies)
    from ..tools.sweeps.sweep import make_jobs, run_jobs
    from ..tools.wandb_metrics import check_wandb

    check_wandb(options.wandb)
    jobs = [
        replace(job, wandb=options.wandb or "")
        for job in make_jobs(options.names, options.seeds, options.out)
    ]
    try:
        if options.ray is None:
            failed = run_jobs(jobs, options.workers or 1)
        else:
            from ..core.ray_cluster import connect
            from ..tools.sweeps.sweep_ray import RayWorker, count_begun, find_unmet_needs

            connect(options.ray)
            for line in find_unmet_needs(jobs):
                note(line)
            failed = run_jobs(jobs, options.workers or len(jobs), RayWorker, count_begun)
    except KeyboardInterrupt:
        note("stopped; the same command resumes it", "")
        raise
    if failed:
        fail(
            f"{len(failed)} of {len(jobs)} runs failed, see {', '.join(str(j.log) for j in failed)}"
        )
    say(f"{len(jobs)} runs are complete in {options.out}")


def tune(arguments: list[str]) -> None:
    """Searches for the best values of a recipe's fields."""
    parser = Parser(
        "tune",
        "Search for the best values of a recipe's fields, with Optuna: trials are runs, and those "
        "whose returns stay low are pruned. The same command resumes a search. The recipe's fields "
        "are options, as of `train NAME`.",
        allow_abbrev=False,  # --seed is a field
    )
    parser.add_argument("name", help="name of a recipe, or a JSON or Python file")
    parser.add_argument(
        "--space", type=Path, help="JSON file with the search space; default: the recipe's, if ppo"
    )
    parser.add_argument(
        "--seeds", type=int, nargs="+", help="of each trial; default: the recipe's seed"
    )
    for name, default, words in (
        ("trials", 50, "trials of the whole search"),
        ("workers", 1, "trials at a time, each a process"),
    ):
        help = f"{words}; default: {default}"
        parser.add_argument(option(name), type=int, default=default, metavar="N", help=help)
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of the search; best.json is its result"
    )
    options, typed = parser.parse_known_args(arguments)
    check_numbers(options, trials=Copies, workers=Copies)
    from ..core.algorithm import make_algorithm
    from ..core.registry import find_recipe
    from ..tools.sweeps.search_space import load_space
    from ..tools.sweeps.tune import Search, Settings, importances
    from .train import parse_recipe

    recipe, _ = parse_recipe(find_recipe(options.name), typed, f"tune {options.name}")
    space = load_space(options.space, recipe)
    given = {word.partition("=")[0].replace("_", "-").replace("--no-", "--") for word in typed}
    for name in map(option, space):
        if name in given:
            fail(f"{name} is searched, so it has no value: leave it out, or out of --space")
    make_algorithm(recipe).check()
    settings = Settings(recipe, space, seeds=tuple(dict.fromkeys(options.seeds or [recipe.seed])))
    with Search(options.out, settings) as search:
        try:
            failed = search.run(options.trials, options.workers)
        except KeyboardInterrupt:
            note("stopped; the same command resumes it", "")
            raise
        best = search.best()
    if failed:
        note(f"trials {failed} failed: see trial-N/*.log in {options.out}")
    if best is None:
        fail(f"no trial in {options.out} is complete")
    values = ", ".join(f"{field} {value}" for field, value in best.params.items())
    say(f"best of {len(search.study.trials)} trials: {number(best.values[0])} with {values}")
    say(f"its recipe: {options.out / 'best.json'}")
    if shares := importances(search.study):
        named = ", ".join(f"{field} {share:.0%}" for field, share in shares.items())
        say(f"what mattered: {named}")
    say(f"all trials: {options.out / 'trials.csv'}")
