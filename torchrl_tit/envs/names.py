"""Tasks by name: Gymnasium's names, and TorchRL environments in modules."""

import difflib
from collections.abc import Callable
from types import ModuleType
from typing import Any

import gymnasium
from torchrl.envs import EnvBase

from torchrl_tit.extras import install
from torchrl_tit.settings.imports import import_module
from torchrl_tit.settings.plugins import load_plugins

# The packages that register names with these prefixes; extras of the same names install them.
_PACKAGES = {
    "BabyAI-": "minigrid",
    "MiniGrid-": "minigrid",
    "TMaze-": "torchrl_tit.tasks",
    "popgym-": "popgym",
}


def find_task(name: str) -> str | Callable[..., EnvBase]:
    """Resolves a task's name, and registers it with Gymnasium if necessary.

    Args:
        name: A name that Gymnasium has registered; one from a package that this library knows, such
            as "MiniGrid-Empty-5x5-v0"; "module:Name-v0", where the module registers the name; or
            "module:Name", a class or function in the module that makes a TorchRL environment.

    Returns:
        The name for `gymnasium.make`, or the class or function.

    Raises:
        ValueError: If there is no such name, module or class, the module cannot be imported, or it
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
    known = {key.lower(): key for key in gymnasium.registry}
    nearest = [known[key] for key in difflib.get_close_matches(name.lower(), known, n=3)]
    hint = (
        f"did you mean {' or '.join(map(repr, nearest))}"
        if nearest
        else "is it registered by a module of yours, as in 'module:Name-v0', or is it an Atari "
        "game, with a name such as 'ALE/Pong-v5'"
    )
    return ValueError(
        f"Unknown task {name!r}; {hint}? `gymnasium.pprint_registry()` lists all names"
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
    made = getattr(module, own, None)
    found, hint = f"has a {type(made).__name__} of that name", ""
    if made is None:
        found = "has no such name"
    elif isinstance(made, type):
        if issubclass(made, EnvBase):
            return made
        found = "has a class of that name, which is no EnvBase"
        if issubclass(made, gymnasium.Env):
            hint = "; a Gymnasium task needs a name, with gymnasium.register in the module"
    elif callable(made):
        return made
    raise ValueError(
        f"Task {name!r}: Gymnasium knows no {own!r} after importing {module.__name__}, which "
        f"{found}; expected a registered name, or a class or function that makes a TorchRL "
        f"EnvBase{hint}."
    )
