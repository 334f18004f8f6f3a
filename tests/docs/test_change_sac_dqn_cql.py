"""What docs/how-to/change-sac-dqn-cql.md overrides changes what is trained, saved and loaded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from recipes.core.metrics import read_metrics
from recipes.core.run import Run
from recipes.core.runner import evaluate, load_trained, train
from tests.docs.test_tutorials import BLOCK
from tests.recipes.small import SETTINGS, make_data
from torchrl_tit.settings.networks import mlp

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "change-sac-dqn-cql.md"
ONLINE: dict[str, Any] = {
    "backbone": mlp(2, hidden_dim=8),
    "batch_size": 8,
    "random_steps": 20,
    "steps_per_batch": 10,
    "total_steps": 60,
    "updates_per_step": 0.2,
    "log_interval": 20,
    "evaluation_episodes": 1,
}


@pytest.fixture(scope="module")
def page() -> dict[str, Any]:
    """What the page defines, before it trains anything."""
    names: dict[str, Any] = {"__name__": "__main__"}
    *blocks, _ = [code for _, language, _, code in BLOCK.findall(PAGE.read_text())]
    for code in blocks:
        exec(compile(code, PAGE.name, "exec"), names)
    return names


def run(recipe: Any, folder: Path) -> tuple[Any, list[dict[str, float]]]:
    """Trains; returns the algorithm that is loaded from the run, and the metrics."""
    with Run.create(folder, recipe) as run:
        train(recipe, run)
        assert evaluate(run)["steps"] == recipe.final_step
        assert type(run.recipe) is type(recipe)
        return load_trained(run)[1], read_metrics(run.folder / "metrics.csv")


def test_sac_stores_other_rewards(page: dict[str, Any], tmp_path: Path) -> None:
    recipe = page["Frugal"](env="Pendulum-v1", **ONLINE)
    algorithm = recipe.build()
    algorithm.prepare(0, tmp_path)
    batch = next(iter(algorithm.batches()))
    before = batch["next", "reward"].clone()
    algorithm.update(batch, 0)
    algorithm.close()
    assert torch.equal(batch["next", "reward"], before)
    stored = algorithm.buffer[:][0]
    expected = before[0] - 0.1 * batch["action"][0].square()
    torch.testing.assert_close(stored["next", "reward"], expected)
    run(recipe, tmp_path / "run")


def test_dqn_trains_and_saves_another_head(page: dict[str, Any], tmp_path: Path) -> None:
    recipe = page["Predictive"](env="CartPole-v1", **ONLINE)
    torch.manual_seed(recipe.seed)
    untrained = recipe.build().model.predictor.weight
    algorithm, rows = run(recipe, tmp_path / "run")
    assert not torch.equal(algorithm.model.predictor.weight, untrained)
    assert rows[-1]["loss_prediction"] > 0
    assert rows[-1]["loss"] > rows[-1]["loss_prediction"]


def test_cql_clones(page: dict[str, Any], tmp_path: Path) -> None:
    settings = {**SETTINGS, "backbone": mlp(hidden_dim=8), "critic_hidden": (8,)}
    data = str(make_data(tmp_path))
    actors = []
    for weight in (0.0, 1.0):
        recipe = page["Cloning"](env="Hopper-v5", dataset=data, cloning_weight=weight, **settings)
        algorithm, rows = run(recipe, tmp_path / f"run-{weight}")
        assert (rows[-2]["loss_bc"] != 0) == bool(weight)
        actors.append(algorithm.model.actor_network_params.data)
    assert not (actors[0] == actors[1]).all()
    _, rows = run(replace(recipe, cloning_updates=1), tmp_path / "first")
    assert np.isnan(rows[0]["loss_bc"])
