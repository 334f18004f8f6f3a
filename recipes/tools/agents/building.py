"""Agents that act, from the files of an agent or from a run folder."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from torchrl_tit.agents import AgentError, TrainedAgent
from torchrl_tit.agents.folder import RECIPE, AgentFiles
from torchrl_tit.evaluation_file import BEST_EVALUATION, EVALUATION
from torchrl_tit.settings.choices import Device

from ...core.algorithm import Algorithm, load_weights, make_algorithm
from ...core.progress import read_state
from ...core.recipe import Recipe
from ...core.recipe_json import recipe_from_json, recipe_to_json
from ...core.run import Run
from ...core.runner import load_networks, with_fresh_seed
from ...decision_transformer import SequenceRecipe


def agent_from_files(files: AgentFiles, name: str, device: Device) -> TrainedAgent:
    """Builds an agent from its files.

    Args:
        files: the contents of the files.
        name: the agent's name.
        device: device of the policy and of the environments.

    Raises:
        AgentError: if the weights do not fit the recipe.
        ValueError: if the recipe cannot be read, or its task or networks cannot be built.
    """
    recipe = recipe_from_json(files.recipe, files.folder / RECIPE)
    try:
        algorithm = make_algorithm(_acting(recipe, files.evaluation, device))
    except (MemoryError, RuntimeError) as error:  # networks larger than the memory
        raise AgentError(
            f"the agent {files.folder} cannot be used: its networks cannot be built "
            f"({' '.join(str(error).split())})"
        ) from error
    networks = algorithm.policy
    try:
        load_weights(networks, files.weights)
    except (RuntimeError, ValueError) as error:
        raise AgentError(
            f"the agent {files.folder} cannot be used: its weights do not fit {RECIPE} in this "
            f"version of torchrl-tit ({' '.join(str(error).split())})"
        ) from error
    return _agent(name, recipe, algorithm, files.steps, files.evaluation, files.versions)


def agent_from_run(folder: Path, device: Device, *, best: bool = False) -> TrainedAgent:
    """Builds an agent from a run's newest checkpoint.

    Args:
        folder: the run folder.
        device: device of the policy and of the environments.
        best: whether to take the best weights of the checkpoint instead of the last ones.

    Raises:
        FileNotFoundError: if there is no run or no checkpoint.
        CheckpointError: if it cannot be used.
        ValueError: as in :func:`agent_from_files`, or if there are no best weights yet.
    """
    run = Run.open(folder)
    recipe, (step, state) = run.recipe, run.load_trained()
    trained = step
    if best:
        with run.restoring(step):
            trained = state["best"]["step"]
            recipe = with_fresh_seed(recipe, read_state(state["record"], recipe))
    evaluation = evaluation_of(run, trained, best=best)
    # Loading sets the number of PyTorch's threads, which is up to the caller here.
    acting = replace(_acting(recipe, evaluation, device), threads=torch.get_num_threads())
    trained, algorithm = load_networks(run, acting, step, state, best=best)
    return _agent(str(folder), recipe, algorithm, trained, evaluation, run.versions())


def evaluation_of(run: Run, steps: int | None, *, best: bool = False) -> dict[str, Any]:
    """Reads a run's evaluation of its last or best weights, of a step; empty if there is none."""
    with suppress(OSError, ValueError):
        evaluation = run.read_evaluation(BEST_EVALUATION if best else EVALUATION)
        if evaluation is not None and evaluation["steps"] == steps:
            return evaluation
    return {}


def _acting(recipe: Recipe, evaluation: Mapping[str, Any], device: Device) -> Recipe:
    """The recipe with the device to act on, and the better of several target returns."""
    recipe = replace(recipe, device=device)
    if isinstance(recipe, SequenceRecipe):
        targets, better = recipe.target_returns, evaluation.get("target_return")
        recipe = replace(recipe, target_returns=(better if better in targets else targets[0],))
    return recipe


def _agent(
    name: str,
    recipe: Recipe,
    algorithm: Algorithm[Any],
    steps: int,
    evaluation: Mapping[str, Any],
    versions: Mapping[str, Any],
) -> TrainedAgent:
    policy = algorithm.policy
    return TrainedAgent(
        name=name,
        policy=policy.eval(),
        make_env=algorithm.make_env,
        recipe=json.loads(recipe_to_json(recipe)),
        steps=steps,
        evaluation=evaluation,
        versions=versions,
        plays=partial(_play, algorithm, steps),  # deepcopy shares closures
    )


def _play(algorithm: Algorithm[Any], steps: int, episodes: int, seed: int) -> Sequence[float]:
    """Plays episodes as the algorithm's evaluation does."""
    if not algorithm.recipe.env:
        raise ValueError("there is no environment to play in: act on observations with act()")
    algorithm.recipe = replace(algorithm.recipe, evaluation_episodes=episodes, evaluation_seed=seed)
    return algorithm.play(steps)[0].returns
