"""Recipes of conservative Q-learning: their steps, dropout, targets, and how data are read."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torchrl.modules import set_recurrent_mode

from tests.datasets.rollouts import roll, write
from tests.recipes.small import (
    SMALL,
    double,
    make_algorithm,
    make_cql,
    make_discrete_cql,
    tit,
    train,
)
from torchrl_tit.networks import HistoryNetwork

RATES = {"temperature": 0.02, "critic": 3e-3, "actor": 1e-3}
NETWORKS = {"log_alpha": "temperature", "qvalue_network": "critic", "actor_network": "actor"}


def test_temperature_and_critics_then_actor_then_targets(tmp_path, monkeypatch):
    """The formulas of the losses are held against others in tests/objectives/test_cql.py."""
    rates = {f"{name}_learning_rate": rate for name, rate in RATES.items()}
    recipe = make_cql(tmp_path, backbone=SMALL, tau=0.1, gamma=0.97, **rates)
    algorithm, batch = double(recipe, tmp_path)
    loss, seen = algorithm.model, []
    compute = algorithm._loss

    def recording(samples):
        terms = compute(samples)
        seen.append((samples, {name: term.detach() for name, term in terms.items()}))
        return terms

    monkeypatch.setattr(algorithm, "_loss", recording)
    before = {name: weight.clone() for name, weight in loss.state_dict().items()}
    terms = algorithm.update(batch, 0)
    after = {name: weight.clone() for name, weight in loss.state_dict().items()}

    for name, weight in after.items():
        if name.startswith("target_") and "_params" in name:
            source = after[name.removeprefix("target_")]
            torch.testing.assert_close(weight, 0.9 * before[name] + 0.1 * source)
        for network, kind in NETWORKS.items():
            if name.startswith(network) and not name.endswith(("low", "high")):
                # Adam's first step is the learning rate, wherever there is a gradient.
                moved = (weight - before[name]).abs().max().item()
                assert moved == pytest.approx(RATES[kind], rel=1e-2), name

    # The actor's loss reads the temperature and the critics that were stepped before.
    [(samples, first)] = seen
    torch.testing.assert_close(terms["loss_actor"], algorithm.actor_loss(samples)["loss_actor"])
    loss.load_state_dict(before)
    unstepped = algorithm.actor_loss(samples)["loss_actor"]
    assert not torch.isclose(terms["loss_actor"], unstepped, rtol=1e-6)
    for name in ("loss_alpha", "loss_qvalue"):
        torch.testing.assert_close(terms[name], first[name])
    assert loss.value_estimator.gamma.item() == pytest.approx(0.97)


def test_the_actor_clones_first_and_then_maximizes_values(tmp_path, monkeypatch):
    recipe = make_cql(tmp_path, backbone=SMALL, cloning_updates=2)
    algorithm, batch = double(recipe, tmp_path)
    model, taken = algorithm.model, []

    def watch(name):
        compute = getattr(model, name)

        def watched(samples):
            loss, others = compute(samples)
            taken.append((name, loss.item()))
            return loss, others

        monkeypatch.setattr(model, name, watched)

    for name in ("actor_loss", "actor_bc_loss"):
        watch(name)
    terms = [algorithm.update(batch, step)["loss_actor"].item() for step in range(3)]
    names = ["actor_bc_loss", "actor_bc_loss", "actor_loss"]
    assert taken == list(zip(names, terms, strict=True))


def test_the_temperature_begins_where_the_recipe_says(tmp_path):
    algorithm, _ = double(make_cql(tmp_path, backbone=SMALL, alpha_init=0.05), tmp_path)
    assert algorithm.model.log_alpha.exp().item() == pytest.approx(0.05)


@pytest.mark.parametrize("make", [make_cql, make_discrete_cql])
def test_dropout_is_on_in_updates_and_off_in_evaluations(tmp_path, make, monkeypatch):
    settings = {"critic": "backbone"} if make is make_cql else {}
    recipe = make(tmp_path, total_updates=2, evaluation_interval=2, **settings)
    seen = set()
    forward = HistoryNetwork.forward

    def watch(network, history):
        modes = {module.training for module in network.modules()}
        seen.add(("update" if len(history) == recipe.batch_size else "evaluation", *modes))
        return forward(network, history)

    monkeypatch.setattr(HistoryNetwork, "forward", watch)
    train(recipe, tmp_path / "run")
    assert seen == {("update", True), ("evaluation", False)}


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


@pytest.mark.parametrize("slice_length", [1, 4])
def test_the_discrete_value_is_that_of_the_recorded_actions(tmp_path, slice_length):
    """Not the mean over all actions, which falls without end as the others are pushed down."""
    recipe = make_discrete_cql(tmp_path, backbone=SMALL, slice_length=slice_length)
    algorithm = make_algorithm(recipe)
    algorithm.prepare(0, tmp_path)
    batch = next(algorithm.batches())
    with torch.no_grad(), set_recurrent_mode(slice_length > 1):
        values = algorithm.policy(batch.copy())["action_value"]
        terms = algorithm.loss(batch.copy())
    recorded = values.take_along_dim(batch["action"].unsqueeze(-1), -1).mean()
    assert not torch.isclose(recorded, values.mean(), rtol=1e-3)
    torch.testing.assert_close(terms["value"], recorded)


def test_how_the_data_are_read_is_passed_on(tmp_path):
    """Files without time limits, and with gaps."""
    rolled = roll()
    names = ("observations", "actions", "rewards", "terminals")
    bare = {name: rolled[name] for name in names}
    bare["terminals"] = np.zeros_like(bare["terminals"])
    data, steps = str(write(tmp_path / "bare.hdf5", bare)), len(rolled["rewards"])
    limited = make_cql(tmp_path, dataset=data, max_episode_steps=20, unfinished="keep")
    dropped = math.ceil(steps / 20)  # the last of each
    assert len(make_algorithm(limited).make_buffer()) == steps - dropped
    rolled["next_observations"] = rolled["next_observations"] + np.float32(1)
    data = str(write(tmp_path / "torn.hdf5", rolled))
    recipe = make_cql(tmp_path, dataset=data, gaps="cut", time_limits="keep")
    assert len(make_algorithm(recipe).make_buffer()) == steps
    for padding, empty in (("same", False), ("constant", True)):
        padded = make_cql(tmp_path, backbone=tit(3), padding=padding)
        history = make_algorithm(padded).make_buffer().storage.get(torch.tensor([0]))["history"]
        assert (not history[:, :-1].any()) == empty
