"""Small runs of Decision Transformer's recipes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from recipes.decision_transformer import DT, SequenceAlgorithm, SequenceRecipe
from recipes.online_decision_transformer import ODT
from tests.recipes.dataset_runs import make_data
from torchrl_tit.settings.networks import dt_tit

SMALL: dict[str, Any] = {"num_frames": 6, "embed_dim": 16, "num_blocks": 2}
SETTINGS: dict[str, Any] = {
    "env": "Hopper-v5",
    "target_returns": (40.0, 10.0),
    "batch_size": 8,
    "learning_rate": 1e-3,
    "warmup_updates": 4,
    "evaluation_episodes": 3,
    "log_interval": 5,
    "checkpoint_interval": 4,
}


def make_dt(folder: Path, **settings: Any) -> DT:
    fields = {
        "name": "dt/hopper/small",
        "dataset": str(make_data(folder)),
        "backbone": dt_tit(**SMALL),
        "iterations": 2,
        "updates_per_iteration": 9,
    }
    return DT(**{**SETTINGS, **fields, **settings})


def make_odt(folder: Path, **settings: Any) -> ODT:
    fields = {
        "name": "odt/hopper/small",
        "dataset": str(make_data(folder)),
        "backbone": dt_tit(**SMALL, timestep_embedding=False),
        "acting_num_frames": 3,
        "online_return": 60.0,
        "pretraining_updates": 6,
        "rounds": 3,
        "updates_per_round": 4,
        "capacity": 5,
        "evaluation_interval": 2,
    }
    return ODT(**{**SETTINGS, **fields, **settings})


def make_algorithm(recipe: SequenceRecipe) -> Any:
    """The algorithm, with its own methods and not only those of all."""
    algorithm = recipe.build()
    assert isinstance(algorithm, SequenceAlgorithm)
    return algorithm
