"""The files of an agent, from a run."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import fields, replace
from importlib import resources
from pathlib import Path, PurePath
from typing import Any

from safetensors.torch import save
from torch import Tensor, nn

from torchrl_tit.agents import AgentError
from torchrl_tit.agents.folder import CARD, RECIPE, VERSIONS, WEIGHTS
from torchrl_tit.agents.hub import import_hub
from torchrl_tit.evaluation_file import EVALUATION
from torchrl_tit.settings.imports import allowed_modules

from ...core.numbers import measured_words, plus_minus
from ...core.recipe import DatasetRecipe, Recipe
from ...core.recipe_json import recipe_to_json
from ...core.run import Run
from ...core.runner import load_trained
from .building import evaluation_of


def pack(
    folder: Path,
    name: str,
    *,
    source: str | None = None,
    license: str | None = None,
    best: bool = False,
) -> tuple[dict[str, bytes], int]:
    """Makes the files of an agent from a run's newest checkpoint and its evaluation.

    They hold what acting needs and a record of how the agent was trained: no optimizer, no replay
    buffer, no networks that only training uses, and no names of folders or machines.

    Args:
        folder: the run folder.
        name: the agent's name, the title of its card.
        source: what :func:`~torchrl_tit.agents.load_agent` will find it by, for its card; its name
            if None.
        license: identifier of its license, such as "mit", for its card; none is named if None.
        best: whether to take the best weights of the checkpoint instead of the last ones.

    Returns:
        The files by name, as :func:`~torchrl_tit.agents.folder.write_agent` takes them, and the
        steps that the agent was trained for.

    Raises:
        FileNotFoundError: if there is no run or no checkpoint.
        AgentError: if these weights were not evaluated, a name is invalid, or huggingface_hub,
            which writes the card's metadata, is missing.
        ValueError: if the run's networks cannot be built, or it has no best weights yet.
    """
    _check_words("name", name)
    if license is not None:
        _check_words("license", license)
    run = Run.open(folder)
    steps, algorithm, _ = load_trained(run, best=best)
    evaluation = evaluation_of(run, steps, best=best)
    if not evaluation:
        which = "best weights, those" if best else "newest checkpoint, that"
        raise AgentError(
            f"{folder} has no evaluation of its {which} of step {steps}: run "
            f"`evaluate {folder}{' --best' * best}` first"
        )
    networks = algorithm.policy
    recipe = without_places(run.recipe)
    if isinstance(recipe, DatasetRecipe):
        evaluation["dataset"] = recipe.dataset
    metadata = _metadata(name, license, recipe, evaluation)
    card = _card(
        recipe,
        evaluation,
        name=name,
        source=source or name,
        steps=steps,
        versions=run.versions(),
        start=", starting with the weights of another run" if run.initial_weights else "",
        parameters=sum(weight.numel() for weight in networks.parameters()),
    )
    files = {
        CARD: f"---\n{metadata}\n---\n\n{card}".encode(),
        RECIPE: recipe_to_json(recipe).encode(),
        WEIGHTS: save(_weights(networks)),
        EVALUATION: _json(evaluation),
        VERSIONS: _json(run.versions()),
    }
    return files, steps


def without_places(recipe: Recipe) -> Recipe:
    """Returns a recipe without the folders and addresses of the machines that it ran on.

    If the data set is a file, the file's name is kept.

    Example:
        >>> from recipes.core.registry import get_recipe
        >>> recipe = replace(get_recipe("bc/hopper-medium-v2/mlp"), dataset="/data/hopper.hdf5")
        >>> without_places(recipe).dataset
        'hopper.hdf5'
    """
    changed: dict[str, Any] = {}
    if isinstance(recipe, DatasetRecipe):
        path = PurePath(recipe.dataset)
        if path.is_absolute() or path.suffix:  # otherwise it is a name from D4RL or Minari
            changed["dataset"] = path.name
    if "ray" in {field.name for field in fields(recipe)}:
        changed["ray"] = None
    return replace(recipe, **changed)


def _weights(networks: nn.Module) -> dict[str, Tensor]:
    """The tensors of networks by name, each with its own memory."""
    weights = {}
    for name, value in networks.state_dict().items():
        if not isinstance(value, Tensor):
            raise AgentError(f"{name} is a {type(value).__name__}, and safetensors hold tensors")
        weights[name] = value.detach().cpu().contiguous().clone()
    return weights


def _check_words(what: str, value: str) -> None:
    if not re.fullmatch(r"\w[\w.-]*", value):
        raise AgentError(f"{what} must be letters, digits, '_', '.' and '-', not {value!r}")


def _json(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=2) + "\n").encode()


def _card(recipe: Recipe, evaluation: Mapping[str, Any], **facts: Any) -> str:
    """Writes the card of an agent in Markdown."""
    settings = [f"`{setting}`" for setting in [*recipe.env_settings, *recipe.wrappers]]
    hidden = " without velocities" if getattr(recipe, "hide_velocities", False) else ""
    versions = "\n".join(f"| {name} | {version} |" for name, version in facts["versions"].items())
    template = resources.files(__package__).joinpath("card.md").read_text(encoding="utf-8")
    return template.format(
        **{**facts, "versions": versions},
        recipe=recipe,
        evaluation=evaluation,
        task=f"`{recipe.env or 'recorded data'}`{hidden}"
        + (f" with {', '.join(settings)}" if settings else ""),
        unit="gradient steps" if recipe.offline else "environment steps",
        data=f", on the data set `{evaluation['dataset']}`" if "dataset" in evaluation else "",
        recipe_name=f"`{recipe.name}`, " if recipe.name else "",
        results=_results(evaluation),
        imports="".join(
            f"import {PurePath(module).name.removesuffix('.py')}  # not in torchrl-tit\n"
            for module in allowed_modules()
        ),
        use=_PLAY if recipe.env else _ACT,
    )


_PLAY = """env = agent.make_env(8, seed=0)  # with everything that the policy reads
steps = env.rollout(100, agent.policy, break_when_any_done=False)
print(agent.evaluate(10))  # the returns of 10 episodes"""
_ACT = """agent.reset()
action = agent.act(observation)  # for each observation of an episode"""


def _results(evaluation: Mapping[str, Any]) -> str:
    """Says what an evaluation found."""
    if "mean" not in evaluation:
        return (
            f"There is no environment. On {evaluation['held_out_episodes']} episodes that were "
            f"held out of training: **{measured_words(evaluation)}**."
        )
    target, first, episodes = "", evaluation["seed"], evaluation["episodes"]
    if "target_return" in evaluation:
        target = f" The policy was told to aim for a return of {evaluation['target_return']:g}."
    if evaluation.get("weights") == "best":
        target += " The weights had the highest return in training; these episodes are new."
    return (
        f"Mean return **{plus_minus(evaluation['mean'], evaluation['std'])}** (standard deviation) "
        f"over\n{episodes} whole episodes, each with its own seed ({first} to "
        f"{first + episodes - 1}), always the most\nlikely action, in the task's own "
        f"rewards.{target} The return of each episode is in\n`evaluation.json`."
    )


def _metadata(name: str, license: str | None, recipe: Recipe, evaluation: Mapping[str, Any]) -> str:
    """The metadata in YAML, written by the Hub's own library."""
    hub = import_hub()
    task = "reinforcement-learning"
    results = []
    if "mean" in evaluation:
        result = hub.EvalResult(
            task_type=task,
            task_name=task,
            dataset_type=recipe.env,
            dataset_name=recipe.env,
            metric_type="mean_reward",
            metric_name="mean_reward",
            metric_value=f"{evaluation['mean']:.2f} +/- {evaluation['std']:.2f}",
        )
        results.append(result)
    tags = [task, "deep-reinforcement-learning", "torchrl", recipe.env, recipe.algorithm]
    data = hub.ModelCardData(
        library_name="torchrl-tit",
        license=license,
        pipeline_tag=task,
        tags=[tag for tag in tags if tag],
        model_name=name,
        eval_results=results or None,
    )
    return str(data.to_yaml()).strip()
