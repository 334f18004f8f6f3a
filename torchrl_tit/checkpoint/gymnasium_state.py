"""The state of a Gymnasium environment, its wrappers and its vector environment, by layer."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np

from torchrl_tit.checkpoint.physics import ATTRIBUTES, class_name, mujoco_state, set_mujoco_state

_Layer = gym.Env[Any, Any] | gym.vector.VectorEnv[Any, Any, Any]

_SPACES = ("action_space", "observation_space", "_action_space", "_observation_space")


def layers(env: _Layer) -> Iterator[_Layer]:
    """Iterates over an environment from its outermost wrapper to its core.

    Args:
        env: a Gymnasium environment or vector of environments.

    Yields:
        Each wrapper, the environment itself, and the layers of each copy in a vector.

    Example:
        >>> import gymnasium as gym
        >>> [type(layer).__name__ for layer in layers(gym.make("CartPole-v1"))]
        ['TimeLimit', 'OrderEnforcing', 'PassiveEnvChecker', 'CartPoleEnv']
    """
    yield env
    if isinstance(env, gym.Wrapper | gym.vector.VectorWrapper):
        yield from layers(env.env)
    elif isinstance(env, gym.vector.SyncVectorEnv):
        for part in env.envs:
            yield from layers(part)


def layer_state(layer: _Layer) -> dict[str, Any]:
    """Returns the state of one layer.

    Args:
        layer: one of :func:`layers`; its class must be listed in
            :data:`~torchrl_tit.checkpoint.physics.ATTRIBUTES`.

    Returns:
        Its class, its attributes, its random generators and, for MuJoCo, the physics.

    Example:
        >>> import gymnasium as gym
        >>> env = gym.make("CartPole-v1", max_episode_steps=10)
        >>> _ = env.reset(seed=0)
        >>> layer_state(env)["attributes"]
        {'_elapsed_steps': 0}
    """
    name = class_name(layer)
    # Some environments have no state before the first reset.
    attributes = {key: getattr(layer, key, None) for key in ATTRIBUTES[name]}
    state: dict[str, Any] = {
        "class": name,
        "attributes": {
            key: list(value) if isinstance(value, deque) else deepcopy(value)
            for key, value in attributes.items()
        },
        "spaces": {key: _space_generator(space) for key, space in _spaces(layer).items()},
    }
    if _is_core(layer):
        # This creates a lazy generator, so that the saved and the restored run have the same one.
        state["np_random"] = _generator_state(layer.np_random)
        state["np_random_seed"] = layer._np_random_seed
        if hasattr(layer, "model"):
            state["mujoco"] = mujoco_state(layer)
    return state


def set_layer_state(layer: _Layer, state: dict[str, Any]) -> None:
    """Restores the state of one layer, see :func:`layer_state`.

    Args:
        layer: a layer of the same class.
        state: what :func:`layer_state` returned.

    Raises:
        ValueError: the attributes of the state are not those that change in such a layer.

    Example:
        >>> import gymnasium as gym
        >>> env, other = gym.make("CartPole-v1"), gym.make("CartPole-v1")
        >>> _ = env.reset(seed=0)
        >>> for source, target in zip(layers(env), layers(other)):
        ...     set_layer_state(target, layer_state(source))
        >>> bool((other.unwrapped.state == env.unwrapped.state).all())
        True
    """
    known = ATTRIBUTES[class_name(layer)]
    if sorted(state["attributes"]) != sorted(known):
        raise ValueError(
            f"the state of {class_name(layer)} has the attributes {sorted(state['attributes'])}, "
            f"but those that change are {sorted(known)}"
        )
    for key, value in state["attributes"].items():
        present = getattr(layer, key, None)
        if isinstance(present, deque):
            setattr(layer, key, deque(value, present.maxlen))
        else:
            setattr(layer, key, deepcopy(value))
    for key, space in _spaces(layer).items():
        if state["spaces"][key] is None:
            space._np_random = None  # type: ignore[assignment]  # not seeded, in Gymnasium
        else:
            space.np_random.bit_generator.state = state["spaces"][key]
    if _is_core(layer):
        layer.np_random.bit_generator.state = state["np_random"]
        layer._np_random_seed = state["np_random_seed"]
        if "mujoco" in state:
            set_mujoco_state(layer, state["mujoco"])
    elif isinstance(layer, gym.wrappers.RecordEpisodeStatistics):
        layer.episode_start_time = time.perf_counter()
    elif isinstance(layer, gym.wrappers.vector.RecordEpisodeStatistics):
        layer.episode_start_times = np.full(layer.num_envs, time.perf_counter())


def _is_core(layer: _Layer) -> bool:
    """Whether a layer is an environment without wrappers, which has a generator and physics."""
    return isinstance(layer, gym.Env) and not isinstance(layer, gym.Wrapper)


def _spaces(layer: _Layer) -> dict[str, gym.Space[Any]]:
    """Returns a layer's own spaces; a wrapper also shows those of the layer below."""
    owned = {key: vars(layer).get(key) for key in _SPACES}
    return {key: space for key, space in owned.items() if isinstance(space, gym.Space)}


def _space_generator(space: gym.Space[Any]) -> dict[str, Any] | None:
    return None if space._np_random is None else _generator_state(space.np_random)


def _generator_state(generator: np.random.Generator) -> dict[str, Any]:
    return dict(generator.bit_generator.state)
