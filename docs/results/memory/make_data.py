"""Writes tmaze-50, -100 and -500.hdf5, experts in corridors of 50, 100 and 500 steps.

Writes tmaze-100-mixed.hdf5, too, in which every other episode ends at the wrong side.
"""

import numpy as np

from torchrl_tit.datasets import episodes_from_arrays, write_hdf5
from torchrl_tit.tasks import TMaze

RIGHT, UP, DOWN = 0, 1, 3


def play(length: int, episodes: int, wrong_every: int) -> list[tuple]:
    """Walks down corridors, and turns to the wrong side in each episode of that number."""
    env, rows = TMaze(length), []
    for episode in range(episodes):
        observation, _ = env.reset(seed=episode)
        right_is_up = (observation[1] > 0) != (episode % wrong_every == wrong_every - 1)
        for action in [RIGHT] * length + [UP if right_is_up else DOWN]:
            following, reward, terminated, _, _ = env.step(np.int64(action))
            rows.append((observation, action, reward, terminated))
            observation = following
    return rows


NEVER = 1_000_000
for name, *settings in (
    ("50", 50, 200, NEVER),
    ("100", 100, 200, NEVER),
    ("100-mixed", 100, 400, 2),
    ("500", 500, 100, NEVER),
):
    arrays = (np.array(column) for column in zip(*play(*settings), strict=True))
    write_hdf5(episodes_from_arrays(*arrays), f"tmaze-{name}.hdf5")
