"""Recipes of conservative Q-learning: dropout and target networks."""

from __future__ import annotations

import pytest
import torch

from recipes.cql import DiscreteCQL
from tests.recipes.small import (
    make_algorithm,
    make_cql,
    make_discrete_cql,
    train,
)
from torchrl_tit.networks import HistoryNetwork


@pytest.mark.parametrize("make", [make_cql, make_discrete_cql])
def test_dropout_is_on_in_updates_and_off_in_evaluations(tmp_path, make, monkeypatch):
    recipe = make(tmp_path, **({"critic": "backbone"} if make is make_cql else {}))
    seen = set()
    forward = HistoryNetwork.forward

    def watch(network, history):
        modes = {module.training for module in network.modules()}
        seen.add(("update" if len(history) == recipe.batch_size else "evaluation", *modes))
        return forward(network, history)

    monkeypatch.setattr(HistoryNetwork, "forward", watch)
    train(recipe, tmp_path / "run")
    assert seen == {("update", True), ("evaluation", False)}
    algorithm = make_algorithm(recipe)
    batch = algorithm.make_buffer().sample()

    def loss():
        if isinstance(recipe, DiscreteCQL):
            return algorithm.model(batch.clone())["loss_qvalue"]
        return algorithm.model.actor_loss(samples)[0]  # through the critics

    samples = algorithm.model.sample_policy(batch) if make is make_cql else None
    assert loss() != loss()
    algorithm.policy.eval()
    if make is make_cql:
        algorithm.model.qvalue_network.eval()  # which the loss does not list among its modules
    assert loss() == loss()


def test_the_discrete_target_follows_the_trained_network_slowly(tmp_path):
    algorithm = make_algorithm(make_discrete_cql(tmp_path, tau=0.25))
    algorithm.prepare(0, tmp_path)
    loss = algorithm.model
    before = loss.target_value_network_params.data.clone()
    algorithm.update(next(algorithm.batches()), 0)
    trained, target = loss.value_network_params.data, loss.target_value_network_params
    for name, weight in target.data.items(True, True):
        if weight.is_floating_point():
            torch.testing.assert_close(weight, 0.75 * before[name] + 0.25 * trained[name])
    assert not (trained == before).all()
