"""The choice of the agent for `data collect`."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from gymnasium import Space

from torchrl_tit.settings.networks import mlp

from ..algorithm import make_algorithm
from ..recipe import Recipe
from ..registry import find_recipe
from ..run import Run
from ..sac import SAC
from .agent import Agent, FinishedRun
from .agent_in_training import AgentInTraining
from .settings import Collection

_CHANGES = ("env_settings", "wrappers", "observation_keys")
"""Fields of a recipe that change the observations, actions or rewards of the task."""


def find_agent(settings: Collection, folder: Path, action_space: Space) -> Agent | None:
    """Finds the agent that the settings name, and checks that it fits the task.

    Args:
        settings: the settings of the collection.
        folder: where an agent is trained; not touched here.
        action_space: action space of the task.

    Returns:
        The agent; None if no set needs one.

    Raises:
        ValueError: if there is no such agent, or it does not fit the task or the sets.
        FileNotFoundError: if it is a run without a checkpoint, or a JSON file that does not exist.
    """
    if set(settings.sets) == {"random"}:
        return None
    if (Path(settings.agent) / "recipe.json").is_file():
        run = Run.open(Path(settings.agent))
        _check(run.recipe, settings.env)
        return FinishedRun(run, settings)
    recipe = _default_sac(settings) if settings.agent == "sac" else find_recipe(settings.agent)
    _check(recipe, settings.env)
    algorithm = make_algorithm(_adapted(recipe, settings))
    algorithm.check()
    return AgentInTraining(algorithm, settings, folder, action_space)


def _default_sac(settings: Collection) -> SAC:
    """SAC's defaults, with the networks of the agents that made D4RL's data."""
    backbone = mlp(hidden_dim=256, activation="relu")
    return SAC(name="sac", env=settings.env, backbone=backbone, total_steps=settings.total_steps)


def _adapted(recipe: Recipe, settings: Collection) -> Recipe:
    """The recipe with the collection's seed, threads and checkpoints, and a single collector."""
    # With several collectors, a batch does not continue the one before.
    single: dict[str, Any] = {"collectors": 1, "ray": None}
    names = {field.name for field in fields(recipe)}
    return replace(
        recipe,
        seed=settings.seed,
        threads=settings.threads,
        checkpoint_interval=settings.checkpoint_interval,
        **{name: value for name, value in single.items() if name in names},
    )


def _check(recipe: Recipe, env: str) -> None:
    """Raises ValueError if a recipe cannot produce the data of a task."""
    problem = None
    if recipe.offline:
        problem = "is trained on a data set, not in its task"
    elif recipe.env != env:
        problem = f"is of the task {recipe.env}, not {env}"
    elif getattr(recipe, "hide_velocities", False):
        problem = "hides the velocities, which the data should have"
    elif changed := [name for name in _CHANGES if getattr(recipe, name)]:
        problem = f"changes the task with {' and '.join(changed)}, so its data are of another"
    if problem:
        name = recipe.name or f"of {recipe.algorithm}"
        raise ValueError(
            f"the recipe {name} {problem}: choose sac, or another ppo or sac recipe, with --agent"
        )
