"""Small runs of the recipes of Decision Transformer, and of other recipes on data sets."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import torch

from recipes.decision_transformer import DT, ODT
from recipes.metrics import read_metrics
from recipes.offline.recipe import OfflineRecipe
from recipes.run import Run
from tests.datasets.rollouts import roll, write
from torchrl_tit.checkpoint import checkpoint_steps, load_checkpoint
from torchrl_tit.networks import DecisionTransformerConfig

SMALL: dict[str, Any] = {
    "embed_dim": 16,
    "num_blocks": 2,
    "context": 6,
    "state_encoder": "inner_transformer",
}
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


def make_data(folder: Path) -> Path:
    return write(folder / "hopper.hdf5", roll())


def make_dt(folder: Path, **settings: Any) -> DT:
    fields = {
        "name": "dt/hopper/small",
        "dataset": str(make_data(folder)),
        "backbone": DecisionTransformerConfig(**SMALL),
        "iterations": 2,
        "updates_per_iteration": 9,
    }
    return DT(**{**SETTINGS, **fields, **settings})


def make_odt(folder: Path, **settings: Any) -> ODT:
    fields = {
        "name": "odt/hopper/small",
        "dataset": str(make_data(folder)),
        "backbone": DecisionTransformerConfig(
            action_space="gaussian", timestep_embedding=False, **SMALL
        ),
        "acting_context": 3,
        "online_return": 60.0,
        "pretraining_updates": 6,
        "rounds": 3,
        "updates_per_round": 4,
        "capacity": 5,
        "evaluation_interval": 2,
    }
    return ODT(**{**SETTINGS, **fields, **settings})


def train(recipe: OfflineRecipe[Any], folder: Path) -> Run:
    with Run.create(folder, recipe) as run:
        recipe.train(run)
    return run


def assert_resumes_bit_for_bit(recipe: OfflineRecipe[Any], folder: Path) -> None:
    """Goes on from the checkpoint before the last, which falls within an interval of metrics."""
    whole = train(recipe, folder / "whole")
    expected = load_checkpoint(whole.checkpoints)
    shutil.copytree(whole.folder, folder / "cut")
    with Run.open(folder / "cut") as run:
        *_, before, last = checkpoint_steps(run.checkpoints)
        assert last == recipe.final_step
        assert before % recipe.log_interval
        shutil.rmtree(run.checkpoints / f"{last:012d}")
        torch.manual_seed(123)  # where the process that resumes happens to be
        recipe.train(run)
        assert_same(load_checkpoint(run.checkpoints), expected)
        rows = [without_time(r) for r in read_metrics(run.folder / "metrics.csv")]
    assert rows == [without_time(r) for r in read_metrics(whole.folder / "metrics.csv")]


def without_time(row: dict[str, float]) -> dict[str, str]:
    return {name: str(value) for name, value in row.items() if name != "time"}


def assert_same(left: Any, right: Any) -> None:
    assert type(left) is type(right)
    if isinstance(left, dict):
        assert left.keys() == right.keys()
        for key in left:
            assert_same(left[key], right[key])
    elif isinstance(left, list | tuple):
        for a, b in zip(left, right, strict=True):
            assert_same(a, b)
    elif isinstance(left, torch.Tensor):
        assert torch.equal(left, right)
    elif isinstance(left, int | float | str):
        assert left == right
