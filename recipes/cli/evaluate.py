"""`evaluate`: a trained run plays episodes, or is measured on data."""

from __future__ import annotations

import hashlib
import re
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchrl_tit.evaluation_file import BEST_EVALUATION, EVALUATION

from ..core.numbers import measured_words, plus_minus
from ..core.recipe import Recipe
from .arguments import Parser, add_machine_options, fail, override, say


def evaluate(arguments: list[str]) -> None:
    """Evaluates the newest checkpoint of a run: its last weights, or its best ones."""
    parser = Parser("evaluate", "Evaluate a run's newest checkpoint.")
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument(
        "--env",
        help="another task to play, with the same observations and actions; default: the recipe's",
    )
    parser.add_argument(
        "--env-settings",
        nargs="+",
        metavar="NAME=VALUE",
        help="settings of the task; default: the recipe's",
    )
    parser.add_argument("--episodes", type=int, help="episodes; default: the recipe's")
    parser.add_argument(
        "--seed", type=int, help="seed of the first episode, or of --ope; default: the recipe's"
    )
    parser.add_argument(
        "--best",
        action="store_true",
        help="the weights with the highest return so far, not the last ones; they play new "
        "episodes, with other seeds than those by which they were chosen",
    )
    parser.add_argument(
        "--dataset",
        help="data to measure the policy on instead: action errors, likelihoods, values",
    )
    parser.add_argument(
        "--ope",
        choices=["fqe", "wis"],
        help="also estimate the policy's return from the data, by fitted Q evaluation or, for "
        "discrete actions, weighted importance sampling",
    )
    parser.add_argument(
        "--out",
        type=Path,
        help="file to write; default: RUN/evaluation.json, with _best and other --env, "
        "--env-settings, --episodes, --seed, --dataset or --ope in its name: it never replaces the "
        "run's own evaluation",
    )
    add_machine_options(parser)
    options = parser.parse_args(arguments)
    from ..core import runner  # not at the top: help needs no PyTorch
    from ..core.run import Run

    run = Run.open(options.run)
    task_settings = options.env_settings
    if options.env and not run.recipe.env:
        task_settings = task_settings or []  # those of the recipe say what the data are
    recipe = override(
        run.recipe,
        env=options.env,
        env_settings=None if task_settings is None else tuple(task_settings),
        evaluation_episodes=options.episodes,
        evaluation_seed=options.seed,
        device=options.device,
        threads=options.threads,
    )
    if options.out is not None and not options.out.absolute().parent.is_dir():
        fail(f"--out {options.out} cannot be written: there is no folder {options.out.parent}")
    if options.out is not None and options.out.is_dir():
        fail(f"--out {options.out} is a folder: name a file in it, such as evaluation.json")
    if options.ope is not None and options.dataset is None:
        fail("--ope estimates returns from data: name them with --dataset FILE")
    if options.dataset is not None and (options.env or options.env_settings):
        fail("--env and --env-settings name what is played: leave them out where data are measured")
    data_alone = options.dataset is not None or not recipe.env
    if data_alone and options.episodes is not None:
        fail("--episodes are those that are played: leave it out where data are measured")
    if data_alone and options.seed is not None and options.ope is None:
        fail("--seed is for episodes or --ope: leave it out where data alone are measured")
    name = _file_name(run.recipe, recipe, options.best, options.dataset, options.ope)
    kept = [run.folder / own for own in (EVALUATION, BEST_EVALUATION) if own != name]
    if options.out is not None and options.out.resolve() in [file.resolve() for file in kept]:
        fail(f"--out {options.out} holds another evaluation of the run: leave it out for {name}")
    # Only one process at a time may write to the run folder.
    lock: AbstractContextManager[Any] = run if options.out is None else nullcontext()
    with lock:
        if options.dataset is None:
            evaluation = runner.evaluate(run, recipe, best=options.best)
        else:
            from ..tools.off_policy import evaluate_on_data

            settings = {"best": options.best, "ope": options.ope}
            evaluation = evaluate_on_data(run, recipe, options.dataset, **settings)
        if options.seed is not None and options.dataset is None:
            # The best weights play from another seed where they were chosen by this one.
            recipe = replace(recipe, evaluation_seed=evaluation["seed"])
        name = _file_name(run.recipe, recipe, options.best, options.dataset, options.ope)
        out = options.out or _free(run.folder / name, options.dataset)
        run.save_evaluation(evaluation, out)
    say(f"{one_line(recipe, evaluation)}\nwritten to {out}")


def _file_name(
    own: Recipe, recipe: Recipe, best: bool, dataset: str | None, ope: str | None
) -> str:
    """Builds a file name from the settings that differ from the run's own evaluation."""
    parts = ["evaluation", *(["best"] if best else [])]
    if recipe.env != own.env:
        parts.append(f"env-{recipe.env}")
    if recipe.env_settings != own.env_settings:
        parts += recipe.env_settings
    for field in ("episodes", "seed"):
        value = getattr(recipe, f"evaluation_{field}")
        if value != getattr(own, f"evaluation_{field}"):
            parts.append(f"{field}-{value}")
    if dataset is not None:
        parts += [f"dataset-{Path(dataset).stem}", *([ope] if ope else [])]
    return re.sub(r"[^.=\w-]+", "-", "_".join(parts)) + ".json"


def _free(path: Path, dataset: str | None) -> Path:
    """Adds a checksum to the name of a file that holds the evaluation on other data."""
    if dataset is None or not path.is_file():
        return path
    from torchrl_tit.evaluation_file import parse_object  # not at the top: help is fast

    if parse_object(path.read_bytes(), str(path)).get("dataset") == dataset:
        return path
    return path.with_stem(f"{path.stem}-{hashlib.sha256(dataset.encode()).hexdigest()[:6]}")


def one_line(recipe: Recipe, evaluation: dict[str, Any]) -> str:
    """Returns an evaluation in one line, and what was measured on held-out episodes in another."""
    best = evaluation["weights"] == "best"
    if "returns" not in evaluation:
        chosen = ", chosen on held-out episodes" if best else ""
        return (
            f"{recipe.name}: after {evaluation['steps']} {recipe.unit} ({evaluation['weights']} "
            f"weights{chosen}), {_measured(evaluation)}"
        )
    new = f", on new episodes from seed {evaluation['seed']}" if best else ""
    held_out = f"\n{_measured(evaluation)}" if "held_out" in evaluation else ""
    return (
        f"{recipe.name}: return {plus_minus(evaluation['mean'], evaluation['std'])} over "
        f"{evaluation['episodes']} episodes of {recipe.env} after {evaluation['steps']} "
        f"{recipe.unit} ({evaluation['weights']} weights{new}){held_out}"
    )


def _measured(evaluation: dict[str, Any]) -> str:
    """What was measured on episodes of data, in words."""
    episodes = evaluation["held_out_episodes"]
    text = f"on {episodes} episodes of {evaluation['dataset']}: {measured_words(evaluation)}"
    if "ope" in evaluation:
        low, high = f"{evaluation['low']:.4g}", f"{evaluation['high']:.4g}"
        text += (
            f"\ndiscounted return ({evaluation['gamma']}) by {evaluation['ope']}: "
            f"{evaluation['value']:.4g} ({low} to {high} over episodes); of the data: "
            f"{evaluation['data_value']:.4g}"
        )
    if "behavior" in evaluation:
        text += (
            f"\nprobabilities of the data's actions: {evaluation['behavior']}; the weights are "
            f"worth {evaluation['effective_episodes']:.1f} episodes"
        )
    return text
