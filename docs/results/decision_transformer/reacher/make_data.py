"""Writes reacher.hdf5 in D4RL's layout: 300 episodes of Reacher-v5 by mediocre controllers.

Each episode has a controller of its own, which pulls the fingertip to the target by a gain, brakes
too little, and is disturbed: torques = gain * J^T * distance - brake * velocity + noise.
"""

import gymnasium
import h5py
import numpy as np

EPISODES, STEPS, NOISE = 300, 50, 0.3
GAINS, BRAKES = (2.0, 8.0), (0.0, 0.03)
NAMES = ["observations", "actions", "rewards", "terminals", "timeouts", "next_observations"]

env = gymnasium.make("Reacher-v5")
rng = np.random.default_rng(0)
rows: dict[str, list] = {name: [] for name in NAMES}
for episode in range(EPISODES):
    gain, brake = rng.uniform(*GAINS), rng.uniform(*BRAKES)
    observation, _ = env.reset(seed=episode)
    for _ in range(STEPS):
        first = np.arctan2(observation[2], observation[0])
        both = first + np.arctan2(observation[3], observation[1])
        y, x = 0.11 * np.sin(both), 0.11 * np.cos(both)  # of the second link
        jacobian = np.array([[-0.1 * np.sin(first) - y, -y], [0.1 * np.cos(first) + x, x]])
        pull = 10 * gain * (jacobian.T @ -observation[8:10])
        noise = NOISE * rng.standard_normal(2)
        action = np.clip(pull - brake * observation[6:8] + noise, -1, 1).astype(np.float32)
        following, *outcome, _ = env.step(action)
        for name, value in zip(NAMES, (observation, action, *outcome, following), strict=True):
            rows[name].append(value)
        observation = following

with h5py.File("reacher.hdf5", "w") as file:
    for name in NAMES:
        kind = bool if name in ("terminals", "timeouts") else np.float32
        file[name] = np.array(rows[name], dtype=kind)
