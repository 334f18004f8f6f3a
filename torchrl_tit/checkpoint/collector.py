"""The state of TorchRL's synchronous collector, including the environment."""

from __future__ import annotations

from typing import Any

import numpy as np
from tensordict import TensorDictBase
from torchrl.collectors import BaseCollector, Collector

from torchrl_tit.checkpoint.environment import can_save_env, env_state, set_env_state


def collector_state(collector: Collector) -> dict[str, Any]:
    """Returns the state of a collector between two of its batches.

    TorchRL's own `state_dict` lacks the environment and the tensordict that the collector carries
    from one batch to the next; this state has both. The policy is not included and must be saved
    separately.

    Args:
        collector: a synchronous collector.

    Returns:
        A state that a checkpoint can hold; it shares no memory with the collector. If
        :func:`~torchrl_tit.checkpoint.can_save_env` is False, the environment's state and the
        carried tensordict are None: :func:`reset_unsavable_env` resets such an environment.

    Example:
        >>> from torchrl.collectors import Collector
        >>> from torchrl.envs import GymEnv
        >>> collector = Collector(GymEnv("CartPole-v1"), frames_per_batch=8, total_frames=16)
        >>> batch = next(iter(collector))
        >>> collector_state(collector)["frames"]
        8
        >>> collector.shutdown()
    """
    savable = can_save_env(collector.env)
    return {
        "frames": collector._frames,
        "iteration": collector._iter,
        "trajectories": collector._traj_pool.state_dict() if collector.track_traj_ids else None,
        "env": env_state(collector.env) if savable else None,
        "carried": collector._carrier.clone() if savable else None,
    }


def set_collector_state(collector: Collector, state: dict[str, Any]) -> None:
    """Restores the state of a collector, before iterating over it.

    Building a collector and its environment draws from the global random generators, so restore
    those last.

    Args:
        collector: a collector with the same settings and policy weights as the saved one.
        state: what :func:`collector_state` returned.

    Raises:
        ValueError: the state is from another kind of environment, only one of the two collectors
            tracks trajectories, or a count is invalid.

    Example:
        >>> from torchrl.collectors import Collector
        >>> from torchrl.envs import GymEnv
        >>> first = Collector(GymEnv("CartPole-v1"), frames_per_batch=8, total_frames=16)
        >>> batch = next(iter(first))
        >>> second = Collector(GymEnv("CartPole-v1"), frames_per_batch=8, total_frames=16)
        >>> set_collector_state(second, collector_state(first))
        >>> len(list(second))
        1
        >>> first.shutdown(); second.shutdown()
    """
    if collector.track_traj_ids != (state["trajectories"] is not None):
        raise ValueError(
            "only one of the saved collector and this one tracks trajectories; use the settings of "
            "the saved collector"
        )
    for name in ("frames", "iteration"):
        if type(state[name]) is not int or state[name] < 0:
            raise ValueError(f"the collector's {name} is {state[name]!r}, not a whole number")
    if state["env"] is not None:
        set_env_state(collector.env, state["env"])
        collector._carrier = _placed_like(state["carried"], collector._carrier)
    if collector.track_traj_ids:
        collector._traj_pool.load_state_dict(state["trajectories"])
    collector._frames = state["frames"]
    collector._iter = state["iteration"]


def reset_unsavable_env(collector: BaseCollector, seed: int, step: int) -> None:
    """Starts new episodes if the environment cannot be saved.

    Call it after saving a checkpoint and after loading one. The seed depends only on the run's seed
    and the step, so a resumed run is the same as one that was not stopped. Environments that can be
    saved, and collectors with several processes, are left unchanged.

    Args:
        collector: the run's collector.
        seed: the run's seed.
        step: the checkpoint's step.

    Example:
        >>> from torchrl.collectors import Collector
        >>> from torchrl.envs import GymEnv
        >>> collector = Collector(GymEnv("CartPole-v1"), frames_per_batch=8, total_frames=16)
        >>> reset_unsavable_env(collector, seed=0, step=8)  # CartPole can be saved
        >>> collector.shutdown()
    """
    if not isinstance(collector, Collector):
        return
    # A collector closes its environment after the last batch.
    if not can_save_env(collector.env) and not collector.env.is_closed:
        collector.reset(seed=np.random.SeedSequence([seed, step]).generate_state(1).item())


def _placed_like(carried: TensorDictBase, present: TensorDictBase) -> TensorDictBase:
    """Copies a loaded tensordict to the devices of the present one."""
    placed = carried.clone().clear_device_()
    for key, value in present.items(include_nested=True, leaves_only=True):
        if key in placed.keys(include_nested=True):
            placed.set(key, placed.get(key).to(value.device))
    return placed if present.device is None else placed.to(present.device)
