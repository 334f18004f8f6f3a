"""Writes tmaze-10, -50, -100 and -500.hdf5, experts in corridors of so many steps.

Writes tmaze-100-mixed.hdf5, too, in which every other episode ends at the wrong side.
"""

import numpy as np

from torchrl_tit.datasets import episodes_from_arrays, write_hdf5
from torchrl_tit.tasks import TMaze

RIGHT, UP, DOWN = 0, 1, 3


def play(length: int, episodes: int, wrong_turns: bool = False) -> list[tuple]:
    """Walks down corridors; if asked to, turns to the wrong side in every other one."""
    env, rows = TMaze(length), []
    for episode in range(episodes):
        observation, _ = env.reset(seed=episode)
        goes_up = (observation[1] > 0) != (wrong_turns and episode % 2 == 1)
        for action in [RIGHT] * length + [UP if goes_up else DOWN]:
            following, reward, terminated, _, _ = env.step(np.int64(action))
            rows.append((observation, action, reward, terminated))
            observation = following
    return rows


for name, rows in {
    "10": play(10, 200),
    "50": play(50, 200),
    "100": play(100, 200),
    "100-mixed": play(100, 400, wrong_turns=True),
    "500": play(500, 100),
}.items():
    arrays = (np.array(column) for column in zip(*rows, strict=True))
    write_hdf5(episodes_from_arrays(*arrays), f"tmaze-{name}.hdf5")
