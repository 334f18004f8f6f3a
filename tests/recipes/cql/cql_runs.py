"""Small runs of the recipes of conservative Q-learning, on random rollouts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from recipes.core import algorithm
from recipes.core.recipe import Recipe
from recipes.cql import CQL, DiscreteCQL
from tests.datasets.rollouts import NAMES, Transitions, roll, write
from tests.recipes.dataset_runs import make_data
from torchrl_tit.envs import make_env
from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import enhanced_tit


def tit(num_frames: int = 1, **hyperparameters: Any) -> Network:
    small: dict[str, Any] = {
        "embed_dim": 8,
        "features_dim": 8,
        "attention_dropout_outer": 0.1,
        "ffn_dropout_inner": 0.2,
    }
    return enhanced_tit(num_frames, **{**small, **hyperparameters})


SETTINGS: dict[str, Any] = {
    "backbone": tit(),
    "batch_size": 8,
    "total_updates": 18,
    "evaluation_interval": 9,
    "evaluation_episodes": 3,
    "log_interval": 5,
    "checkpoint_interval": 4,
}


def make_cql(folder: Path, **settings: Any) -> CQL:
    fields = {
        "name": "cql/hopper/small",
        "dataset": str(make_data(folder)),
        "env": "Hopper-v5",
        "critic_hidden": (16, 16),
    }
    return CQL(**{**SETTINGS, **fields, **settings})


def make_discrete_cql(folder: Path, **settings: Any) -> DiscreteCQL:
    fields = {
        "name": "discrete-cql/cartpole/small",
        "dataset": str(make_cartpole_data(folder)),
        "env": "CartPole-v1",
    }
    return DiscreteCQL(**{**SETTINGS, **fields, **settings})


def make_algorithm(recipe: Recipe) -> Any:
    """The algorithm, as Any: it has more than what all algorithms have."""
    return algorithm.make_algorithm(recipe)


def make_cartpole_data(folder: Path) -> Path:
    return write(folder / "cartpole.hdf5", roll(task="CartPole-v1", max_episode_steps=20))


def roll_pong(steps: int = 60) -> Transitions:
    """Random actions in Pong, cut into episodes of 20 images each."""
    env = make_env("ALE/Pong-v5", seed=0)
    step = env.rollout(steps)[0]
    env.close()
    columns = {
        "observations": step["observation"],
        "actions": step["action"],
        "rewards": step["next", "reward"].squeeze(-1),
        "terminals": step["next", "terminated"].squeeze(-1),
        "next_observations": step["next", "observation"],
    }
    arrays = {name: column.numpy() for name, column in columns.items()}
    arrays["timeouts"] = np.arange(steps) % 20 == 19
    assert not arrays["terminals"].any()
    assert set(arrays) == set(NAMES)
    return arrays
