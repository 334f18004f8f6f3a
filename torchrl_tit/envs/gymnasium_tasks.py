"""Copies of a Gymnasium task in a vector environment, in this process or in one process each."""

from __future__ import annotations

import logging
import os
import signal
import sys
import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any

import gymnasium
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv

from torchrl_tit.envs.names import Wrap, task_spec
from torchrl_tit.settings.choices import VectorizationMode
from torchrl_tit.settings.imports import load_plugins

_shown: set[str] = set()  # MuJoCo's warnings

_HAS_SCREEN = any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY")) or (
    sys.platform != "linux"
)


def make_gymnasium_tasks(
    name: str, num_envs: int, mode: VectorizationMode, wraps: Sequence[Wrap], /, **kwargs: Any
) -> gymnasium.vector.VectorEnv:
    """Makes a vector environment of a Gymnasium task, by a name that :func:`find_task` returned.

    Here and below, arguments are positional, because the task's settings may have the same names.

    Raises:
        ValueError: if Gymnasium cannot make it, or cannot make it in a separate process.
    """
    uses_mujoco = "mujoco" in str(task_spec(name).entry_point)
    # GymVectorEnv copies the returned arrays, so the vector environment need not copy them.
    settings: dict[str, Any] = {"copy": False, "autoreset_mode": AutoresetMode.DISABLED}
    copies = [partial(_task, name, tuple(wraps), os.getpid(), uses_mujoco, **kwargs)] * num_envs
    if mode == "sync":
        return SyncVectorEnv(copies, **settings)
    try:
        try:
            return AsyncVectorEnv(copies, **settings)
        except ValueError as error:
            if not isinstance(error.__cause__, gymnasium.error.CustomSpaceError):
                raise
            # A task with a custom space, such as MiniGrid's text.
            return AsyncVectorEnv(copies, shared_memory=False, **settings)
    except (EOFError, ConnectionError) as error:  # a process has ended
        raise ValueError(
            f"Task {name!r} cannot be made in processes of its own, which print the reason: "
            "correct that, or set vectorization_mode to 'sync'"
        ) from error


def make_unchecked(name: str, /, **kwargs: Any) -> gymnasium.Env:
    """Makes one task as Gymnasium does, without its checker and its advice to use a newer version.

    The checker costs time in each step, and the tests check the specs instead. Older versions are
    used on purpose: D4RL's data come from them. Without a screen, SDL is told to draw into memory
    and to play no sound, because it reports an error if it looks for a screen or a sound card.
    """
    if kwargs.get("render_mode") == "rgb_array" and not _HAS_SCREEN:
        for driver in ("SDL_VIDEODRIVER", "SDL_AUDIODRIVER"):
            os.environ.setdefault(driver, "dummy")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".* is out of date", DeprecationWarning)
        return gymnasium.make(name, disable_env_checker=True, **kwargs)


def _task(
    name: str, wraps: Sequence[Wrap], home: int, uses_mujoco: bool, /, **kwargs: Any
) -> gymnasium.Env:
    """Makes one copy, in the process that steps it; ``home`` is the main process."""
    if os.getpid() == home:
        return _make(name, wraps, uses_mujoco, **kwargs)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the main process handles Ctrl-C
    try:
        if ":" not in name and name not in gymnasium.registry:
            _register(name)
        return _make(name, wraps, uses_mujoco, **kwargs)
    except Exception as error:
        line = " ".join(str(error).split())
        raise SystemExit(f"{type(error).__name__}: {line}") from error  # without a traceback


def _register(name: str) -> None:
    """Imports the modules that the user and plugins named, as the main process did."""
    failures = load_plugins()
    if name not in gymnasium.registry:
        reason = (
            f"no module that this process imports registers the task {name!r}: add "
            "`--import MODULE`, or name it 'module:Name-v0'"
        )
        raise ValueError("; ".join([reason, *failures]))


def _make(name: str, wraps: Sequence[Wrap], uses_mujoco: bool, /, **kwargs: Any) -> gymnasium.Env:
    if uses_mujoco:
        show_mujoco_warnings_once()
    try:
        env = make_unchecked(name, **kwargs)
    except Exception as error:  # a package is missing, the task has no such setting, ...
        kind = "" if isinstance(error, gymnasium.error.Error) else f"{type(error).__name__}: "
        raise ValueError(f"Task {name!r} cannot be made: {kind}{error}") from error
    for wrap in wraps:
        env = wrap(env)
    return env


def show_mujoco_warnings_once() -> None:
    """Logs each of MuJoCo's warnings once per process, with the logger ``torchrl_tit.mujoco``.

    By default MuJoCo prints a warning every time (for example, for each environment with an
    outdated model) and appends it to MUJOCO_LOG.TXT in the working directory, so both grow in a
    long run. A handler that the user has set is kept.

    Example:
        >>> import mujoco
        >>> show_mujoco_warnings_once()
        >>> mujoco.get_mju_user_warning() is not None
        True
    """
    import mujoco  # here, since most tasks do not need it

    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_show)


def _show(text: str) -> None:
    # Not warnings.warn: if warnings are errors, an exception in this callback ends the process.
    if text not in _shown:
        _shown.add(text)
        logging.getLogger("torchrl_tit.mujoco").warning("MuJoCo: %s", text)
