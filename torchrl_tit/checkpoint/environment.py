"""The state of a TorchRL environment, from which it resumes bit for bit."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

from torch import Tensor, nn
from torch.nn.parameter import UninitializedBuffer
from torchrl.envs import EnvBase, GymEnv, GymWrapper, TransformedEnv
from torchrl.envs.transforms import VecGymEnvTransform

from torchrl_tit.checkpoint.gymnasium_state import layer_state, layers, set_layer_state
from torchrl_tit.checkpoint.physics import ATTRIBUTES, class_name
from torchrl_tit.envs import GymVectorEnv


def can_save_env(env: EnvBase) -> bool:
    """Returns whether an environment can be saved and resumed.

    All layers must be known: Gymnasium's classic control, toy text and MuJoCo tasks (v4, v5) and
    the T-Maze, with the wrappers that `gymnasium.make` adds and a few more, single or in a
    `SyncVectorEnv`, inside `GymVectorEnv`, `GymWrapper` or `GymEnv` and any `TransformedEnv`. Other
    environments, such as Atari, MiniGrid and TorchRL's own, must be reset at each checkpoint.

    Args:
        env: a TorchRL environment.

    Returns:
        Whether :func:`env_state` accepts it.

    Example:
        >>> from torchrl.envs import GymEnv
        >>> can_save_env(GymEnv("CartPole-v1"))
        True
    """
    return _obstacle(env) is None


def env_state(env: EnvBase) -> dict[str, Any]:
    """Returns the whole state of an environment.

    It consists of the physics, the random generators, the elapsed steps and flags of wrappers, the
    buffers of vector environments, and the buffers of TorchRL's transforms, such as the histories
    of :class:`~torchrl_tit.transforms.History`. Transforms that keep state outside of their
    `state_dict` are not supported, except the one that TorchRL adds to vector environments. The
    tensordict that the caller carries from step to step is not part of the state.

    Args:
        env: an environment for which :func:`can_save_env` is True.

    Returns:
        A state that a checkpoint can hold; it shares no memory with the environment.

    Raises:
        TypeError: the environment or one of its wrappers cannot be saved; the message names it.

    Example:
        >>> from torchrl.envs import GymEnv
        >>> env, other = GymEnv("CartPole-v1"), GymEnv("CartPole-v1")
        >>> carried = env.rand_action(env.reset())
        >>> set_env_state(other, env_state(env))
        >>> ours, theirs = env.step(carried.clone()), other.step(carried.clone())
        >>> bool((ours["next", "observation"] == theirs["next", "observation"]).all())
        True
    """
    if obstacle := _obstacle(env):
        raise TypeError(
            f"an environment with {obstacle} in it cannot be saved; reset it at each checkpoint "
            "instead, with a seed that follows from the run's seed and the step"
        )
    modules, base = _unwrap(env)
    return {
        "modules": [_module_state(module) for module in modules],
        "layers": [layer_state(layer) for layer in layers(base._env)],
    }


def set_env_state(env: EnvBase, state: dict[str, Any]) -> None:
    """Restores the state of an environment, which need not have been reset.

    Args:
        env: an environment with the same settings as the saved one.
        state: what :func:`env_state` returned.

    Raises:
        TypeError: the environment cannot be saved.
        ValueError: the state is from another kind of environment.

    Example:
        >>> from torchrl.envs import GymEnv
        >>> env, other = GymEnv("Pendulum-v1"), GymEnv("CartPole-v1")
        >>> set_env_state(other, env_state(env))  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ValueError: the state is of ...PendulumEnv, ...
    """
    if obstacle := _obstacle(env):
        raise TypeError(f"an environment with {obstacle} in it cannot be restored")
    modules, base = _unwrap(env)
    present = list(layers(base._env))
    names = [class_name(layer) for layer in present]
    saved = [layer["class"] for layer in state["layers"]]
    if names != saved:
        raise ValueError(
            f"the state is of {', '.join(saved)}, but the environment is {', '.join(names)}; "
            "use the settings of the saved environment"
        )
    if len(modules) != len(state["modules"]):
        raise ValueError(
            f"the state is of an environment with {len(state['modules']) - 1} levels of "
            f"transforms, but this one has {len(modules) - 1}; use the settings of the saved "
            "environment"
        )
    for module, saved_module in zip(modules, state["modules"], strict=True):
        _set_module_state(module, saved_module)
    for layer, saved_layer in zip(present, state["layers"], strict=True):
        set_layer_state(layer, saved_layer)


def _unwrap(env: EnvBase) -> tuple[list[nn.Module], EnvBase]:
    """Returns the modules with buffers, from the outermost transform to the core, and the core."""
    transforms: list[nn.Module] = []
    while isinstance(env, TransformedEnv):
        transforms.append(env.transform)
        env = env.base_env
    return [*transforms, env], env


def _obstacle(env: EnvBase) -> str | None:
    """Returns the name of the class that prevents an environment from being saved, if any."""
    _, base = _unwrap(env)
    if type(base) not in (GymVectorEnv, GymWrapper, GymEnv):
        return class_name(base)
    names = map(class_name, layers(base._env))
    return next((name for name in names if name not in ATTRIBUTES), None)


def _module_state(module: nn.Module) -> dict[str, Any]:
    return {
        # None stands for a lazy buffer that has no data yet.
        "buffers": {
            key: None if isinstance(value, UninitializedBuffer) else _copy(value)
            for key, value in _buffers(module).items()
        },
        # TorchRL stores the results of a vector environment's automatic resets here.
        "resets": {
            name: {key: _copy(value) for key, value in part._memo.items()}
            for name, part in module.named_modules()
            if isinstance(part, VecGymEnvTransform)
        },
    }


def _set_module_state(module: nn.Module, state: dict[str, Any]) -> None:
    buffers, present = state["buffers"], _buffers(module)
    if buffers.keys() != present.keys():
        raise ValueError(
            f"the state is of an environment with the buffers {sorted(buffers)}, but this one has "
            f"{sorted(present)}; use the settings of the saved environment"
        )
    known = {key: value for key, value in buffers.items() if value is not None}
    for key, value in known.items():
        if isinstance(present[key], UninitializedBuffer):
            # load_state_dict does not materialize lazy buffers.
            path, _, leaf = key.rpartition(".")
            module.get_submodule(path).register_buffer(leaf, value.clone())
    module.load_state_dict(known, strict=False)
    for name, memo in state["resets"].items():
        part: Any = module.get_submodule(name)
        part._memo = {key: _copy(value) for key, value in memo.items()}


def _buffers(module: nn.Module) -> dict[str, Any]:
    # Without keep_vars PyTorch detaches, and lazy buffers cannot be detached.
    return dict(module.state_dict(keep_vars=True))


def _copy(value: Any) -> Any:
    return value.detach().clone() if isinstance(value, Tensor) else deepcopy(value)
