"""Gradient steps of continuous CQL: their order, their rates and the targets."""

from __future__ import annotations

import pytest
import torch

from tests.recipes.small import SMALL, double, make_cql

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
