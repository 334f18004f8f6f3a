"""Tasks, wrappers and transforms by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from types import ModuleType
from typing import Any

import gymnasium
from torchrl.envs import EnvBase
from torchrl.envs.transforms import EndOfLifeTransform, FrameSkipTransform, Transform

from torchrl_tit.extras import install
from torchrl_tit.settings.checks import nearest
from torchrl_tit.settings.imports import import_module, load_plugins, resolve
from torchrl_tit.settings.literals import parse_call

Wrap = Callable[[gymnasium.Env], gymnasium.Env]

# The packages that register names with these prefixes; extras of the same names install them.
_PACKAGES = {
    "BabyAI-": "minigrid",
    "MinAtar/": "torchrl_tit.tasks",
    "MiniGrid-": "minigrid",
    "TMaze-": "torchrl_tit.tasks",
    "popgym-": "popgym",
}


def find_task(name: str) -> str | Callable[..., EnvBase]:
    """Resolves a task's name, and registers it with Gymnasium if necessary.

    Args:
        name: a name that Gymnasium has registered; one from a package that this library knows, such
            as "MiniGrid-Empty-5x5-v0"; "module:Name-v0", where the module registers the name; or
            "module:Name", a class or function in the module that makes a TorchRL environment.

    Returns:
        The name for `gymnasium.make`, or the class or function.

    Raises:
        ValueError: if there is no such name, module or class, the module cannot be imported, or it
            is neither a registered name nor something that makes a TorchRL environment.

    Example:
        >>> find_task("CartPole-v1")
        'CartPole-v1'
        >>> find_task("torchrl.envs:PendulumEnv").__name__
        'PendulumEnv'
    """
    if ":" not in name:
        return _registered(name)
    module_name, _, own = name.partition(":")
    try:
        module = import_module(module_name)
    except ImportError as error:
        raise ValueError(f"Task {name!r} cannot be made: {error}.") from error
    return name if own in gymnasium.registry else _maker(module, own, name)


def task_spec(name: str) -> Any:
    """Gymnasium's spec of a name that :func:`find_task` returned."""
    return gymnasium.registry[name.rpartition(":")[2]]


def unknown(name: str) -> ValueError:
    """The error for a name that Gymnasium has not registered."""
    return ValueError(
        f"Unknown task {name!r}; {nearest(name, gymnasium.registry)} (all names: "
        "gymnasium.pprint_registry(); one of a module of yours is module:Name-v0, an Atari game "
        "ALE/Pong-v5)"
    )


def _registered(name: str) -> str:
    if name in gymnasium.registry:
        spec = gymnasium.registry[name]
        if str(spec.entry_point).startswith("ale_py"):
            raise ValueError(
                f"Task {name!r} is an Atari game without the preprocessing; use a name such as "
                "'ALE/Pong-v5'."
            )
        return name
    package = next((_PACKAGES[start] for start in _PACKAGES if name.startswith(start)), None)
    if package is None:
        failures = load_plugins()
        if name in gymnasium.registry:
            return name
        raise ValueError("; ".join([str(unknown(name)), *failures]))
    try:
        import_module(package)
    except ImportError as error:
        raise ValueError(f"Task {name!r} needs {package}: {install(package)} ({error}).") from error
    if name not in gymnasium.registry:
        raise unknown(name)
    return f"{package}:{name}"  # so that other processes also import it


def _maker(module: ModuleType, own: str, name: str) -> Callable[..., EnvBase]:
    made: Any = getattr(module, own, None)
    if issubclass(made, EnvBase) if isinstance(made, type) else callable(made):
        return made
    raise ValueError(
        f"Task {name!r}: {module.__name__} neither registers {own!r} with Gymnasium nor has a "
        "class or function of that name that makes a TorchRL EnvBase."
    )


_UNFIT: dict[type[Transform], str] = {
    FrameSkipTransform: (
        "steps on where an episode has ended, and loses its end: repeat actions with "
        "gymnasium.wrappers:RepeatAction(num_repeats=4), or in the task"
    ),
    EndOfLifeTransform: (
        "asks a single game for its lives, but games here step together, and end an episode at "
        "each lost life already"
    ),
}
"""Transforms that cannot be used, and why."""


def load_wrappers(names: Sequence[str]) -> tuple[list[Wrap], list[Transform]]:
    """Finds the wrappers and transforms to apply to a task.

    Args:
        names: Gymnasium wrappers, then TorchRL transforms, as "module:Class" or
            "module:Class(argument=literal)"; the innermost first.

    Returns:
        Functions that apply the Gymnasium wrappers to a task, and the transforms.

    Raises:
        ValueError: if there is no such class, it is of another kind or misses ends of episodes, its
            arguments are invalid, or a wrapper comes after a transform.

    Example:
        >>> wraps, transforms = load_wrappers(
        ...     ["gymnasium.wrappers:FlattenObservation", "torchrl.envs:StepCounter(max_steps=9)"]
        ... )
        >>> wraps[0](gymnasium.make("Taxi-v4")).observation_space.shape, transforms[0].max_steps
        ((500,), 9)
    """
    wraps: list[Wrap] = []
    transforms: list[Transform] = []
    for name in names:
        target, arguments = parse_call(name)
        try:
            import_module(target.partition(":")[0])
            found = resolve(target)
        except ImportError as error:
            raise ValueError(f"Wrapper {name!r} cannot be used: {error}.") from error
        kind = found if isinstance(found, type) else type(None)
        for transform, problem in _UNFIT.items():
            if issubclass(kind, transform):
                raise ValueError(f"Wrapper {name!r} {problem}")
        if issubclass(kind, Transform):
            transforms.append(_called(kind, name, **arguments))
        elif not issubclass(kind, gymnasium.Wrapper):
            raise ValueError(
                f"Wrapper {name!r} is neither a gymnasium.Wrapper nor a TorchRL Transform."
            )
        elif transforms:
            raise ValueError(
                f"Wrapper {name!r} stands after a TorchRL transform: name the gymnasium.Wrappers "
                "first, since they are inside."
            )
        else:
            wraps.append(partial(_called, kind, name, **arguments))
    return wraps, transforms


def _called(kind: Any, name: str, /, *values: Any, **arguments: Any) -> Any:
    try:
        return kind(*values, **arguments)
    except Exception as error:  # a wrapper can raise anything
        raise ValueError(
            f"Wrapper {name!r} cannot be made: {type(error).__name__}: {error}"
        ) from error
