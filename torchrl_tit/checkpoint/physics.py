"""The state of each Gymnasium environment and wrapper between two steps."""

from __future__ import annotations

from typing import Any

import numpy as np

_WRAPPERS = "gymnasium.wrappers"
_CLASSIC = "gymnasium.envs.classic_control"
_TOY = "gymnasium.envs.toy_text"
_MUJOCO = "gymnasium.envs.mujoco"

_EPISODE_QUEUES = ("time_queue", "return_queue", "length_queue")

# The attributes that change after construction, by the full name of the class. Other classes cannot
# be saved: a subclass or an unknown wrapper may have further state.
ATTRIBUTES: dict[str, tuple[str, ...]] = {
    f"{_CLASSIC}.acrobot.AcrobotEnv": ("state",),
    f"{_CLASSIC}.cartpole.CartPoleEnv": ("state", "steps_beyond_terminated"),
    f"{_CLASSIC}.continuous_mountain_car.Continuous_MountainCarEnv": ("state",),
    f"{_CLASSIC}.mountain_car.MountainCarEnv": ("state",),
    f"{_CLASSIC}.pendulum.PendulumEnv": ("state", "last_u"),
    f"{_TOY}.blackjack.BlackjackEnv": ("dealer", "player"),
    f"{_TOY}.cliffwalking.CliffWalkingEnv": ("s", "lastaction"),
    f"{_TOY}.frozen_lake.FrozenLakeEnv": ("s", "lastaction"),
    f"{_TOY}.taxi.TaxiEnv": ("s", "lastaction", "fickle_step", "taxi_orientation"),
    "torchrl_tit.tasks.t_maze.TMaze": ("_x", "_y", "_goal", "_steps"),
    # All state of a MuJoCo environment is in its mjData, see mujoco_state.
    **{
        f"{_MUJOCO}.{module}_{version}.{name}": ()
        for version in ("v4", "v5")
        for module, name in {
            "ant": "AntEnv",
            "half_cheetah": "HalfCheetahEnv",
            "hopper": "HopperEnv",
            "humanoid": "HumanoidEnv",
            "humanoidstandup": "HumanoidStandupEnv",
            "inverted_double_pendulum": "InvertedDoublePendulumEnv",
            "inverted_pendulum": "InvertedPendulumEnv",
            "pusher": "PusherEnv",
            "reacher": "ReacherEnv",
            "swimmer": "SwimmerEnv",
            "walker2d": "Walker2dEnv",
        }.items()
    },
    "gymnasium.vector.sync_vector_env.SyncVectorEnv": (
        *("_env_obs", "_observations", "_rewards"),
        *("_terminations", "_truncations", "_autoreset_envs"),
    ),
    f"{_WRAPPERS}.common.TimeLimit": ("_elapsed_steps",),
    f"{_WRAPPERS}.common.OrderEnforcing": ("_has_reset",),
    f"{_WRAPPERS}.common.PassiveEnvChecker": (
        *("checked_reset", "checked_step", "checked_render", "checked_data_reuse"),
        *("close_called", "_previous_data"),
    ),
    # Without the start times of episodes: clocks of different processes cannot be compared.
    f"{_WRAPPERS}.common.RecordEpisodeStatistics": (
        *("episode_count", "episode_returns", "episode_lengths"),
        *_EPISODE_QUEUES,
    ),
    f"{_WRAPPERS}.vector.common.RecordEpisodeStatistics": (
        *("episode_count", "episode_returns", "episode_lengths", "prev_dones"),
        *_EPISODE_QUEUES,
    ),
    f"{_WRAPPERS}.transform_action.ClipAction": (),
    f"{_WRAPPERS}.transform_action.RescaleAction": (),
    f"{_WRAPPERS}.transform_observation.DtypeObservation": (),
    f"{_WRAPPERS}.transform_observation.FlattenObservation": (),
    f"{_WRAPPERS}.transform_observation.RescaleObservation": (),
    f"{_WRAPPERS}.transform_reward.ClipReward": (),
}

# Positions that MuJoCo computes one substep late: after a step, they belong to the state before the
# last substep. Ant, Humanoid and Reacher read them before they step, so they cannot be recomputed
# from the state.
_LATE_POSITIONS = ("xpos", "xipos")


def class_name(env: object) -> str:
    """Returns the full name of an object's class.

    Args:
        env: an environment or a wrapper.

    Returns:
        Module and class.

    Example:
        >>> import gymnasium as gym
        >>> class_name(gym.make("CartPole-v1").unwrapped)
        'gymnasium.envs.classic_control.cartpole.CartPoleEnv'
    """
    return f"{type(env).__module__}.{type(env).__qualname__}"


def mujoco_state(env: Any) -> dict[str, np.ndarray]:
    """Returns the physics state of a MuJoCo environment.

    Args:
        env: an unwrapped Gymnasium MuJoCo environment.

    Returns:
        MuJoCo's integration state (float64), including the solver's warm start, and body positions
        that are not a function of it.

    Example:
        >>> import gymnasium as gym
        >>> sorted(mujoco_state(gym.make("Hopper-v5").unwrapped))
        ['integration', 'xipos', 'xpos']
    """
    import mujoco  # here, since most tasks do not need it

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    integration = np.empty(mujoco.mj_stateSize(env.model, kind))
    mujoco.mj_getState(env.model, env.data, integration, kind)
    late = {name: getattr(env.data, name).copy() for name in _LATE_POSITIONS}
    return {"integration": integration, **late}


def set_mujoco_state(env: Any, state: dict[str, np.ndarray]) -> None:
    """Restores the physics state of a MuJoCo environment, see :func:`mujoco_state`.

    Args:
        env: an unwrapped environment of the same model.
        state: what :func:`mujoco_state` returned.

    Example:
        >>> import gymnasium as gym
        >>> hopper, other = gym.make("Hopper-v5").unwrapped, gym.make("Hopper-v5").unwrapped
        >>> _ = hopper.reset(seed=0)
        >>> set_mujoco_state(other, mujoco_state(hopper))
        >>> bool((other.data.qpos == hopper.data.qpos).all())
        True
    """
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    mujoco.mj_setState(env.model, env.data, state["integration"], kind)
    for name in _LATE_POSITIONS:
        getattr(env.data, name)[:] = state[name]
