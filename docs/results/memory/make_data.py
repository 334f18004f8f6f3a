"""Writes tmaze-50.hdf5 and tmaze-500.hdf5: experts in corridors of 50 and 500 steps."""

import numpy as np

from torchrl_tit.datasets import episodes_from_arrays, write_hdf5
from torchrl_tit.tasks import TMaze

RIGHT, UP, DOWN = 0, 1, 3

for length, episodes in ((50, 200), (500, 100)):
    env = TMaze(length)
    rows = []
    for episode in range(episodes):
        observation, _ = env.reset(seed=episode)
        for action in [RIGHT] * length + [UP if observation[1] > 0 else DOWN]:
            following, reward, terminated, _, _ = env.step(np.int64(action))
            rows.append((observation, action, reward, terminated))
            observation = following
    arrays = (np.array(column) for column in zip(*rows, strict=True))
    write_hdf5(episodes_from_arrays(*arrays), f"tmaze-{length}.hdf5")
