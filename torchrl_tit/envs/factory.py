"""Gymnasium tasks and Atari games by name."""

import difflib
import os
import signal
from functools import partial
from typing import Any, Literal, get_args

import gymnasium
import torch
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from torchrl.envs import Compose, RewardSum, TransformedEnv

from torchrl_tit.envs.atari import AtariEnv
from torchrl_tit.envs.atari_games import FRAME_SKIP, MAX_NUM_FRAMES, AtariGames
from torchrl_tit.envs.mujoco_warnings import show_mujoco_warnings_once
from torchrl_tit.envs.transformed import TransformedVectorEnv
from torchrl_tit.envs.vector import GymVectorEnv
from torchrl_tit.transforms.hide_velocities import HideVelocities
from torchrl_tit.transforms.history import History
from torchrl_tit.windows import Padding

VectorizationMode = Literal["sync", "async"]


def make_env(
    name: str,
    num_envs: int = 1,
    *,
    seed: int | None = None,
    num_frames: int = 1,
    padding: Padding = "same",
    keep_histories: bool = True,
    hide_velocities: bool = False,
    clip_actions: bool = True,
    vectorization_mode: VectorizationMode = "sync",
    device: torch.device | str | None = None,
    **kwargs: Any,
) -> TransformedEnv:
    """Makes copies of a Gymnasium task or an Atari game, with histories of their observations.

    The environment itself (``.base_env``) writes observations only. Transforms write the rest:
    :class:`~torchrl_tit.transforms.HideVelocities` if asked for, TorchRL's `RewardSum`, and
    :class:`~torchrl_tit.transforms.History`. Add further ones with ``append_transform``.

    ======================  ==================  ===================================================
    key                     shape               what it is
    ======================  ==================  ===================================================
    ``observation``         [N, *obs]           float32, or the task's own integers (images: uint8)
    ``history``             [N, K, *obs]        the last K observations, the newest last
    ``episode_reward``      [N, 1]              float32, the undiscounted return so far
    ``action``              [N] or [N, A]       int64 for discrete actions, else float32
    ``reward``              [N, 1]              float32
    ``terminated``          [N, 1]              bool, the task ended the episode
    ``truncated``           [N, 1]              bool, the time limit ended the episode
    ``done``                [N, 1]              bool, either
    ======================  ==================  ===================================================

    Args:
        name: A name that Gymnasium has registered, such as "CartPole-v1" or "Hopper-v5". Names that
            begin with "ALE/", such as "ALE/Pong-v5", are Atari games with the preprocessing of
            :class:`~torchrl_tit.envs.AtariGames`; they need ale-py, the extra "atari".
        num_envs: N, the number of copies; the batch size is [N], for N = 1 too.
        seed: Copy i is seeded with ``seed + i``; without one, each differs from run to run.
        num_frames: K, the number of observations in a history.
        padding: What fills a history before an episode's first step: see
            :class:`~torchrl_tit.transforms.History`.
        keep_histories: Whether a step still has its histories once it was taken. If not,
            ``step_and_maybe_reset`` removes them, from "next" too, and a collector stores
            observations only; the tensordict that the policy acts on has its histories either way.
        hide_velocities: Whether observations and histories lack the velocities: see
            :class:`~torchrl_tit.transforms.HideVelocities`.
        clip_actions: Whether continuous actions are clipped on their way to the task: see
            :class:`~torchrl_tit.envs.GymVectorEnv`.
        vectorization_mode: ``"sync"`` steps the copies one after the other in this process,
            ``"async"`` side by side in one process each, with the same results, which pays off for
            slow tasks. Atari games always run side by side, in threads.
        device: Device of the tensors; by default they stay on the CPU and the device is None.
        **kwargs: Passed to `gymnasium.make`, such as ``max_episode_steps=200``, or to
            :class:`~torchrl_tit.envs.AtariGames`.

    Returns:
        The environment. Atari games have further keys: see
        :class:`~torchrl_tit.envs.AtariEnv`.

    Raises:
        ValueError: If the name or the mode is unknown, a package that the task needs is missing,
            ``num_envs``, ``num_frames`` or the padding is invalid, Atari games are to run in
            processes, or it is not known which observations are velocities.
        TypeError: If the task's observations or actions are of a kind that is not supported.

    Example:
        >>> env = make_env("CartPole-v1", num_envs=8, seed=0, num_frames=4)
        >>> env.reset()["history"].shape
        torch.Size([8, 4, 4])
        >>> make_env("CartPole-v2")
        Traceback (most recent call last):
        ...
        ValueError: Unknown task 'CartPole-v2'; did you mean one of 'CartPole-v1', 'CartPole-v0'...
    """
    if num_envs < 1:
        raise ValueError(f"num_envs must be at least 1, but is {num_envs}.")
    if vectorization_mode not in get_args(VectorizationMode):
        raise ValueError(
            f"vectorization_mode must be 'sync' or 'async', but is {vectorization_mode!r}."
        )
    env: GymVectorEnv
    if is_atari(name):
        if vectorization_mode == "async":
            raise ValueError(
                f"{name} runs in threads, side by side; leave vectorization_mode at 'sync'."
            )
        env = AtariEnv(make_games(name, num_envs, **kwargs), device=device)
    else:
        tasks = _tasks(name, num_envs, vectorization_mode, **kwargs)
        env = GymVectorEnv(tasks, clip_actions=clip_actions, device=device)
    if seed is not None:
        env.set_seed(seed)
    observation_ndim = env.observation_spec["observation"].ndim - 1
    transform = Compose(
        *([HideVelocities(name)] if hide_velocities else []),
        RewardSum(),
        History(num_frames, observation_ndim=observation_ndim, padding=padding),
    )
    return TransformedVectorEnv(
        env, transform, transient_keys=() if keep_histories else ("history",)
    )


def is_atari(name: str) -> bool:
    """Returns whether a name is that of an Atari game, which begins with "ALE/".

    Args:
        name: A name that Gymnasium may have registered.

    Returns:
        Whether it is an Atari game.

    Example:
        >>> is_atari("ALE/Pong-v5"), is_atari("Hopper-v5")
        (True, False)
    """
    return name.startswith("ALE/")


def time_limit(name: str) -> int | None:
    """Returns the number of steps after which the episodes of a task are truncated.

    Args:
        name: A name as :func:`make_env` takes it.

    Returns:
        The number of steps, or None for a task without a time limit.

    Example:
        >>> time_limit("Hopper-v5"), time_limit("ALE/Pong-v5")
        (1000, 27000)
    """
    if is_atari(name):
        return MAX_NUM_FRAMES // FRAME_SKIP
    return gymnasium.spec(name).max_episode_steps


def make_games(name: str, num_envs: int = 1, **kwargs: Any) -> AtariGames:
    """Makes copies of an Atari game by Gymnasium's name, as :func:`make_env` does.

    Args:
        name: A name such as "ALE/Pong-v5".
        num_envs: The number of copies.
        **kwargs: Passed to :class:`~torchrl_tit.envs.AtariGames`.

    Returns:
        The games.

    Raises:
        ValueError: If the name is unknown, or ale-py is missing.

    Example:
        >>> make_games("ALE/Pong-v5").single_observation_space
        Box(0, 255, (84, 84), uint8)
    """
    return AtariGames(_rom(name), num_envs, **kwargs)


def _tasks(
    name: str, num_envs: int, mode: VectorizationMode, **kwargs: Any
) -> gymnasium.vector.VectorEnv:
    # "module:name" makes Gymnasium import the module, which registers the name.
    if name not in gymnasium.registry and ":" not in name:
        raise _unknown(name)
    spec = gymnasium.registry.get(name)
    if spec is not None and str(spec.entry_point).startswith("ale_py"):
        raise ValueError(
            f"Task {name!r} is an Atari game without the preprocessing; use a name such as "
            "'ALE/Pong-v5'."
        )
    # GymVectorEnv copies what the vector environment returns, which need not copy it before.
    make = partial(_task, os.getpid(), name, **kwargs)
    vectorize = SyncVectorEnv if mode == "sync" else AsyncVectorEnv
    try:
        return vectorize([make] * num_envs, copy=False, autoreset_mode=AutoresetMode.DISABLED)
    except (gymnasium.error.Error, ImportError) as error:  # a package is missing, say
        raise ValueError(f"Task {name!r} cannot be made: {error}") from error


def _task(home: int, name: str, **kwargs: Any) -> gymnasium.Env:
    """Makes one copy, in the process that steps it; ``home`` is the main process."""
    if os.getpid() != home:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process handles Ctrl-C
    if "mujoco" in str(gymnasium.spec(name).entry_point):
        show_mujoco_warnings_once()
    # Gymnasium's checker costs time in each step; the tests check the specs instead.
    return gymnasium.make(name, disable_env_checker=True, **kwargs)


def _rom(name: str) -> str:
    """The name of an Atari game's ROM file."""
    try:
        import ale_py  # an optional extra
    except ImportError as error:
        raise ValueError(
            f"Task {name!r} needs ale-py: pip install 'torchrl-tit[atari]'."
        ) from error
    gymnasium.register_envs(ale_py)
    if name not in gymnasium.registry:
        raise _unknown(name)
    return gymnasium.registry[name].kwargs["game"]


def _unknown(name: str) -> ValueError:
    known = {key.lower(): key for key in gymnasium.registry}
    nearest = [known[key] for key in difflib.get_close_matches(name.lower(), known, n=3)]
    hint = (
        f"did you mean one of {', '.join(map(repr, nearest))}"
        if nearest
        else "is its package imported, or is it an Atari game, with a name such as 'ALE/Pong-v5'"
    )
    return ValueError(
        f"Unknown task {name!r}; {hint}? `gymnasium.pprint_registry()` lists all names."
    )
