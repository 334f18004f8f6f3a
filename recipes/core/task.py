"""The task that a recipe names, for every algorithm."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.envs import Compose, EnvBase

from torchrl_tit.envs import make_env, time_limit
from torchrl_tit.evaluation import check_rewards

from .algorithm import torch_device
from .recipe import Recipe

_PARAMETERS = {*inspect.signature(make_env).parameters, "render_mode"}


def make_task(
    recipe: Recipe,
    num_envs: int = 1,
    seed: int | None = None,
    *,
    state: Compose | None = None,
    **settings: Any,
) -> EnvBase:
    """Builds a recipe's task, with histories of as many frames as its network reads.

    Args:
        recipe: the settings.
        num_envs: number of environments, which are stepped side by side.
        seed: seed of the first environment.
        state: the transforms that carry a network's state; see
            :func:`~recipes.core.networks.state_transforms`.
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
                "field of the recipe, or fixed by the algorithm or command"
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
    env = make_env(recipe.env, num_envs, seed=seed, **values)
    return env.append_transform(state) if state else env


def seed_copies(env: EnvBase, seed: int, step: int = 0, first: int = 0) -> EnvBase:
    """Seeds the environments in which a run trains, each from a random stream of its own.

    So runs with neighboring seeds have no environment in common.

    Args:
        env: the environments, [N], which are reset.
        seed: the run's seed.
        step: steps that the run has done; a resumed run begins new episodes with other seeds.
        first: number of the first environment, if there are more elsewhere.

    Returns:
        The environments.

    Example:
        >>> from torchrl_tit.envs import make_env
        >>> env = seed_copies(make_env("CartPole-v1", 2), seed=0)
        >>> env.close()
    """
    copies = range(first, first + env.batch_size.numel())
    streams = [np.random.SeedSequence(seed, spawn_key=(step, copy)) for copy in copies]
    env.reset(seed=[int(stream.generate_state(1)[0]) >> 1 for stream in streams])
    return env


def play_once(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    keys: Sequence[NestedKey],
    *,
    seed: int | None = None,
    max_steps: int | None = None,
) -> tuple[TensorDictBase, list[int]]:
    """Plays one episode in each of several environments, which are stepped side by side.

    Args:
        env: the environments, [N], which are reset.
        policy: writes the action into the tensordict that it is given.
        keys: the entries of a step to keep, rewards and ends among them; with "game_over", an Atari
            game is played to its end, and not to that of a life.
        seed: seed of the first environment; with None, all keep the seeds that they have.
        max_steps: where longer episodes are cut off.

    Returns:
        The steps on the CPU, [N, T], and the length of each environment's episode; what follows is
        of another one.

    Raises:
        FloatingPointError: if a reward of these episodes is NaN or infinite.
    """
    tensordict = env.reset(seed=seed)
    playing = torch.ones(env.batch_size.numel(), dtype=torch.bool)
    lengths = torch.zeros_like(playing, dtype=torch.int64)
    steps: list[TensorDictBase] = []
    while playing.any() and len(steps) != max_steps:
        step, tensordict = env.step_and_maybe_reset(policy(tensordict))
        steps.append(step.select(*keys, strict=False).cpu())
        outcome = steps[-1]["next"]
        check_rewards(outcome["reward"].flatten().masked_fill(~playing, 0))
        lengths += playing
        playing &= ~outcome.get("game_over", outcome["done"]).flatten()
    return torch.stack(steps, 1), lengths.tolist()


def task_limit(recipe: Recipe) -> int | None:
    """Returns the number of steps after which episodes are truncated; None without a limit."""
    return recipe.task_settings.get("max_episode_steps", time_limit(recipe.env))
