"""Small runs on data sets, and what a resumed run is compared with."""

from __future__ import annotations

import shutil
from pathlib import Path

import torch

from recipes.core import runner
from recipes.core.metrics import read_metrics
from recipes.core.recipe import Recipe
from recipes.core.run import Run
from tests.datasets.rollouts import roll, write
from tests.recipes.states import TIMES, assert_same
from torchrl_tit.checkpoint import checkpoint_steps, load_checkpoint


def make_data(folder: Path) -> Path:
    return write(folder / "hopper.hdf5", roll())


def train(recipe: Recipe, folder: Path) -> Run:
    with Run.create(folder, recipe) as run:
        runner.train(recipe, run)
    return run


def assert_resumes_bit_for_bit(recipe: Recipe, folder: Path) -> None:
    """Resumes from the last checkpoint but one, which lies within an interval of metrics."""
    whole = train(recipe, folder / "whole")
    shutil.copytree(whole.folder, folder / "cut")
    with Run.open(folder / "cut") as run:
        *_, before, last = checkpoint_steps(run.checkpoints)
        assert last == recipe.final_step
        assert before % recipe.log_interval
        shutil.rmtree(run.checkpoints / f"{last:012d}")
        torch.manual_seed(123)  # the resuming process may be in any state
        runner.train(recipe, run)
    assert_same_run(run, whole)


def assert_same_run(run: Run, other: Run) -> None:
    """Compares everything in the newest checkpoints, and all metrics but the time."""
    assert_same(load_checkpoint(run.checkpoints), load_checkpoint(other.checkpoints))
    rows, expected = (
        [
            {name: str(value) for name, value in row.items() if name not in TIMES}
            for row in read_metrics(one.folder / "metrics.csv")
        ]
        for one in (run, other)
    )
    assert rows == expected
