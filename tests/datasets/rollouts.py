"""Transitions of Gymnasium tasks in D4RL's layout, and files of them."""

from pathlib import Path

import gymnasium
import h5py
import numpy as np
from numpy.typing import NDArray

Transitions = dict[str, NDArray]


def roll(
    steps: int = 300, max_episode_steps: int = 15, seed: int = 0, task: str = "Hopper-v5"
) -> Transitions:
    """Random actions: some episodes terminate, some reach the time limit.

    The last transition ends an episode.
    """
    env = gymnasium.make(task, max_episode_steps=max_episode_steps)
    env.action_space.seed(seed)
    rows: dict[str, list] = {name: [] for name in NAMES}
    observation, _ = env.reset(seed=seed)
    ended = False
    while len(rows["rewards"]) < steps or not ended:
        action = env.action_space.sample()
        following, reward, terminal, timeout, _ = env.step(action)
        values = (observation, action, reward, terminal, timeout, following)
        for name, value in zip(NAMES, values, strict=True):
            rows[name].append(value)
        ended = terminal or timeout
        observation = env.reset()[0] if ended else following
    env.close()
    arrays = {name: np.array(values) for name, values in rows.items()}
    assert arrays["terminals"].any()
    assert arrays["timeouts"].any()
    return {n: a.astype(np.float32) if a.dtype.kind == "f" else a for n, a in arrays.items()}


NAMES = ("observations", "actions", "rewards", "terminals", "timeouts", "next_observations")


def write(path: Path, arrays: Transitions, **attributes: str) -> Path:
    """Writes the arrays to an HDF5 file."""
    with h5py.File(path, "w") as file:
        file.attrs.update(attributes)
        for name, array in arrays.items():
            file.create_dataset(name, data=array)
    return path


def spans(arrays: Transitions) -> list[tuple[int, int]]:
    """First row, and row after the last, of each finished episode."""
    stops = np.flatnonzero(arrays["terminals"] | arrays["timeouts"]) + 1
    return list(zip([0, *stops[:-1].tolist()], stops.tolist(), strict=True))
