"""Finds wrappers and transforms of a task by name."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium
from torchrl.envs.transforms import Transform

from torchrl_tit.settings.imports import import_named
from torchrl_tit.settings.literals import parse_call

Wrap = Callable[[gymnasium.Env], gymnasium.Env]


def load_wrappers(names: Sequence[str]) -> tuple[list[Wrap], list[Transform]]:
    """Finds the wrappers and transforms to apply to a task.

    Args:
        names: Gymnasium wrappers, then TorchRL transforms, as "module:Class" or
            "module:Class(argument=literal)"; the innermost first.

    Returns:
        Functions that apply the Gymnasium wrappers to a task, and the transforms.

    Raises:
        ValueError: If there is no such class, it is of another kind, its arguments are invalid, or
            a wrapper comes after a transform.

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
            found = import_named(target)
        except ImportError as error:
            raise ValueError(f"Wrapper {name!r} cannot be used: {error}.") from error
        kind = found if isinstance(found, type) else type(None)
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
            wraps.append(partial(_wrapped, kind, name, arguments))
    return wraps, transforms


def _wrapped(kind: Any, name: str, arguments: dict[str, Any], env: gymnasium.Env) -> gymnasium.Env:
    return _called(kind, name, env, **arguments)


def _called(kind: Any, name: str, *values: Any, **arguments: Any) -> Any:
    try:
        return kind(*values, **arguments)
    except Exception as error:  # a wrapper can raise anything
        raise ValueError(
            f"Wrapper {name!r} cannot be made: {type(error).__name__}: {error}"
        ) from error
