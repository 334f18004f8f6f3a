"""The task that a recipe names, for every algorithm."""

from __future__ import annotations

import inspect
from typing import Any

from torchrl.envs import EnvBase

from torchrl_tit.envs import make_env, time_limit

from .algorithm import torch_device
from .recipe import Recipe

_PARAMETERS = inspect.signature(make_env).parameters


def make_task(
    recipe: Recipe, num_envs: int = 1, seed: int | None = None, **settings: Any
) -> EnvBase:
    """Builds a recipe's task, with histories of as many frames as its network reads.

    Args:
        recipe: the settings.
        num_envs: number of environments, which are stepped side by side.
        seed: seed of the first environment.
        **settings: further settings of :func:`~torchrl_tit.envs.make_env` and of the task, which
            override those of the recipe.

    Raises:
        ValueError: if the task, a wrapper or one of its settings is unknown or wrong, or
            observations or actions are of a kind that is not supported.
    """
    for name in recipe.task_settings:
        if name in _PARAMETERS:
            raise ValueError(
                f"env_settings are settings of {recipe.env} itself, and {name} is none: it is a "
                "field of the recipe, or fixed by the algorithm"
            )
    device = torch_device(recipe.device)
    own = {
        name: getattr(recipe, name)
        for name in ("padding", "hide_velocities", "mask_actions")
        if hasattr(recipe, name)  # not every algorithm has them
    }
    values = {
        "num_frames": recipe.backbone.num_frames,
        "wrappers": recipe.wrappers,
        "observation_keys": recipe.observation_keys,
        "image_layout": recipe.image_layout,
        "device": None if device.type == "cpu" else device,
        **own,
        **recipe.task_settings,
        **settings,
    }
    return make_env(recipe.env, num_envs, seed=seed, **values)


def task_limit(recipe: Recipe) -> int | None:
    """Returns the number of steps after which episodes are truncated; None without a limit."""
    return recipe.task_settings.get("max_episode_steps", time_limit(recipe.env))
