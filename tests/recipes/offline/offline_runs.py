"""Small runs of behaviour cloning, IQL and TD3+BC, on random rollouts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from recipes.bc import BC
from recipes.iql import IQL
from recipes.offline import TransitionRecipe
from recipes.td3bc import TD3BC
from tests.recipes.cql.cql_runs import SETTINGS, make_algorithm, make_cartpole_data
from tests.recipes.dataset_runs import make_data
from torchrl_tit.settings.networks import mlp

SMALL = mlp(hidden_dim=8, activation="relu")


def make(kind: type[TransitionRecipe], folder: Path, **settings: Any) -> Any:
    """A recipe on Hopper, or on the other task that is named."""
    discrete = settings.get("env") == "CartPole-v1"
    data = make_cartpole_data(folder) if discrete else make_data(folder)
    fields: dict[str, Any] = {
        "name": f"{kind.algorithm}/small",
        "dataset": str(data),
        "env": "Hopper-v5",
        "backbone": SMALL,
    }
    if kind is not BC:
        fields["critic_hidden"] = (16,)
    return kind(**{**SETTINGS, **fields, **settings})


def double(recipe: TransitionRecipe, folder: Path) -> tuple[Any, TensorDictBase]:
    """An algorithm in float64, ready for updates, and a batch."""
    torch.manual_seed(0)
    algorithm = make_algorithm(recipe)
    algorithm.model.double()
    algorithm.prepare(0, folder)
    batch = algorithm.buffer.sample()
    return algorithm, batch.apply(lambda x: x.double() if x.is_floating_point() else x)


__all__ = ["BC", "IQL", "SMALL", "TD3BC", "double", "make", "make_algorithm"]
