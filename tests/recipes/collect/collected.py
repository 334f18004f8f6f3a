"""Small collections of data, and how to read and compare them."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from recipes.ppo import PPO
from recipes.sac import SAC
from recipes.tools.collect import Collection
from torchrl_tit.datasets import load_episodes
from torchrl_tit.settings.networks import mlp

FIELDS = ("observations", "actions", "rewards", "terminals", "timeouts", "next_observations")
CARTPOLE_RECIPE = PPO(
    name="ppo/cartpole/small",
    env="CartPole-v1",
    backbone=mlp(num_frames=2, hidden_dim=32),
    num_envs=4,
    total_steps=100_000,
    steps_per_batch=256,
    minibatch_size=64,
    epochs=4,
    learning_rate=1e-3,
    compile="off",
    decay_learning_rate=True,
)
PENDULUM_RECIPE = SAC(
    name="sac/pendulum/small",
    env="Pendulum-v1",
    backbone=mlp(hidden_dim=16, activation="relu"),
    critic_hidden=(16, 16),
    batch_size=16,
    random_steps=100,
    total_steps=400,
    updates_per_step=0.04,
)
# The fixtures in conftest.py write the recipes and fill in their paths.
CARTPOLE = Collection(
    env="CartPole-v1",
    transitions=300,
    medium_return=100,
    expert_return=130,
    total_steps=8192,
    evaluation_interval=256,
    evaluation_episodes=2,
    checkpoint_interval=768,
    num_envs=3,
    deterministic=True,
)
PENDULUM = Collection(
    env="Pendulum-v1",
    transitions=300,
    medium_return=-2000,
    total_steps=400,
    evaluation_interval=200,
    evaluation_episodes=2,
    checkpoint_interval=150,
    num_envs=2,
)


def read(path: Path) -> dict[str, NDArray]:
    with h5py.File(path) as file:
        assert set(file) == set(FIELDS)
        return {name: file[name][:] for name in FIELDS}


def attributes(path: Path) -> dict[str, Any]:
    return dict(load_episodes(path, dtype=None).attributes)


def check_episodes(data: dict[str, NDArray]) -> None:
    """Each episode continues from row to row, and all have an end."""
    ends = data["terminals"] | data["timeouts"]
    assert ends[-1]
    np.testing.assert_array_equal(
        data["observations"][1:][~ends[:-1]], data["next_observations"][:-1][~ends[:-1]]
    )
