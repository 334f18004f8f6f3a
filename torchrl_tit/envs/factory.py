"""Gymnasium tasks by name."""

import difflib
from functools import partial
from typing import Any

import gymnasium
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from torchrl_tit.envs.vector import GymVectorEnv
from torchrl_tit.transforms.history import Padding


def make_env(
    name: str,
    num_envs: int = 1,
    *,
    seed: int | None = None,
    history: int = 1,
    padding: Padding = "same",
    clip_actions: bool = True,
    device: torch.device | str | None = None,
    **kwargs: Any,
) -> GymVectorEnv:
    """Makes copies of a Gymnasium task, stepped one after the other in this process.

    Args:
        name: A name that Gymnasium has registered, such as "CartPole-v1" or "Hopper-v5".
        num_envs: N, the number of copies; the batch size is [N], for N = 1 too.
        seed: Copy i is seeded with ``seed + i``; without one, each differs from run to run.
        history: K, the number of observations in a history.
        padding: How histories begin: see :class:`~torchrl_tit.envs.GymVectorEnv`.
        clip_actions: Whether continuous actions are clipped on their way to the task: see there.
        device: Where the tensors go; by default they stay on the CPU without a stated device.
        **kwargs: Passed to `gymnasium.make`, as ``max_episode_steps=200``.

    Returns:
        The environment, whose keys and shapes stand in :class:`~torchrl_tit.envs.GymVectorEnv`.

    Raises:
        ValueError: If the name is unknown or a package that the task needs is missing,
            ``num_envs`` is less than 1, or history or padding are wrong.
        TypeError: If the task's observations or actions are of a kind that is not supported.

    Example:
        >>> env = make_env("CartPole-v1", num_envs=8, seed=0, history=4)
        >>> env.reset()["history"].shape
        torch.Size([8, 4, 4])
        >>> make_env("CartPole-v2")
        Traceback (most recent call last):
        ...
        ValueError: Unknown task 'CartPole-v2'; did you mean one of 'CartPole-v1', 'CartPole-v0'...
    """
    _check_name(name)
    if num_envs < 1:
        raise ValueError(f"num_envs must be at least 1, but is {num_envs}.")
    # The specs are checked once, in tests; Gymnasium's checker would cost time at every step. What
    # the vector environment returns is copied at once, so it need not make copies of its own.
    make = partial(gymnasium.make, name, disable_env_checker=True, **kwargs)
    try:
        tasks = SyncVectorEnv([make] * num_envs, copy=False, autoreset_mode=AutoresetMode.DISABLED)
    except (gymnasium.error.Error, ImportError) as error:  # a package is missing, say
        raise ValueError(f"Task {name!r} cannot be made: {error}") from error
    env = GymVectorEnv(
        tasks, history=history, padding=padding, clip_actions=clip_actions, device=device
    )
    if seed is not None:
        env.set_seed(seed)
    return env


def _check_name(name: str) -> None:
    # "module:name" makes Gymnasium import the module, which registers the name.
    if name in gymnasium.registry or ":" in name:
        return
    known = {key.lower(): key for key in gymnasium.registry}
    nearest = [known[key] for key in difflib.get_close_matches(name.lower(), known, n=3)]
    hint = (
        f"did you mean one of {', '.join(map(repr, nearest))}"
        if nearest
        else "is its package imported"
    )
    raise ValueError(
        f"Unknown task {name!r}; {hint}? `gymnasium.pprint_registry()` lists all names."
    )
