"""The loss of discrete CQL equals its formulas, written as loops in NumPy."""

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Categorical, OneHot
from torchrl.modules import QValueActor
from torchrl.objectives import SoftUpdate

from torchrl_tit.objectives import DelayedDiscreteCQLLoss

pytestmark = pytest.mark.numerics

BATCH, OBSERVATION, ACTIONS, GAMMA = 6, 4, 3, 0.9
SPECS = {"categorical": Categorical(ACTIONS), "one-hot": OneHot(ACTIONS)}


def make_loss(kind="categorical", network=None, **settings):
    network = network or nn.Linear(OBSERVATION, ACTIONS)
    actor = QValueActor(network.double(), in_keys=["state"], spec=SPECS[kind])
    loss = DelayedDiscreteCQLLoss(actor, action_space=SPECS[kind], **settings)
    loss.make_value_estimator(gamma=GAMMA)
    for weight in loss.target_value_network_params.values(True, True):
        weight.data.normal_()
    return loss


def make_batch(kind="categorical"):
    def states():
        return torch.randn(BATCH, OBSERVATION, dtype=torch.float64)

    terminated = torch.arange(BATCH).unsqueeze(-1) % 3 == 1
    return TensorDict(
        {
            "state": states(),
            "action": SPECS[kind].rand((BATCH,)),
            "next": {
                "state": states(),
                "reward": torch.randn(BATCH, 1, dtype=torch.float64),
                "terminated": terminated,
                "done": terminated | (torch.arange(BATCH).unsqueeze(-1) == 0),
            },
        },
        [BATCH],
    )


@pytest.mark.parametrize("kind", ["categorical", "one-hot"])
def test_the_formulas(kind):
    loss, batch = make_loss(kind), make_batch(kind)

    def values(params, state):
        weight, bias = (
            next(w for key, w in params.items(True, True) if key[-1] == name).detach().numpy()
            for name in ("weight", "bias")
        )
        return weight @ state.numpy() + bias

    error = gap = 0.0
    for b in range(BATCH):
        action = batch["action"][b]
        index = int(action if kind == "categorical" else action.long().argmax())
        q = values(loss.value_network_params, batch["state"][b])
        best = max(values(loss.target_value_network_params, batch["next", "state"][b]))
        # Truncated episodes bootstrap, terminated ones do not.
        future = 0.0 if batch["next", "terminated"][b] else GAMMA * best
        error += (q[index] - batch["next", "reward"][b].item() - future) ** 2 / 2 / BATCH
        gap += (math.log(np.exp(q).sum()) - q[index]) / BATCH
    losses = loss(batch)
    assert losses["loss_qvalue"].item() == pytest.approx(error, rel=1e-6)  # gamma is a float32
    assert losses["loss_cql"].item() == pytest.approx(gap, rel=1e-6)


def test_only_the_trained_network_gets_gradients():
    loss, batch = make_loss(), make_batch()
    losses = loss(batch)
    (losses["loss_qvalue"] + losses["loss_cql"]).backward()
    assert all(w.grad is not None for w in loss.value_network_params.values(True, True))
    assert all(w.grad is None for w in loss.target_value_network_params.values(True, True))
    updater = SoftUpdate(loss, tau=0.5)  # which copies the weights to the targets first
    with torch.no_grad():
        loss.value_network_params.data.add_(1.0)
    before = loss.target_value_network_params.clone()
    updater.step()
    moved = loss.target_value_network_params.data - before.data
    assert all(torch.allclose(w, torch.full_like(w, 0.5)) for w in moved.values(True, True))


def test_the_loss_depends_on_the_target_network():
    """Unlike that of `DiscreteCQLLoss` in TorchRL 0.14.1."""
    loss, batch = make_loss(), make_batch()
    before = loss(batch.clone())["target_value"]
    for weight in loss.target_value_network_params.values(True, True):
        weight.data.zero_()
    assert loss(batch.clone())["target_value"] != before
    expected = batch["next", "reward"].mean()
    torch.testing.assert_close(loss(batch.clone())["target_value"], expected)


def test_reductions():
    names, batch = ["loss_qvalue", "loss_cql"], make_batch()
    first = make_loss()
    losses = {}
    for reduction in ("none", "mean", "sum", None):
        loss = make_loss(reduction=reduction)
        loss.load_state_dict(first.state_dict())
        losses[reduction] = loss(batch).select(*names)
    for name in names:
        each = losses["none"][name]
        assert each.shape == (BATCH,)
        torch.testing.assert_close(losses["sum"][name], each.sum())
        torch.testing.assert_close(losses["mean"][name], each.mean())
        torch.testing.assert_close(losses[None][name], each.mean())


def test_keys_can_be_set():
    names = {"action": "a", "reward": "r", "done": "d", "terminated": "t", "priority": "p"}
    loss, batch = make_loss(), make_batch()
    renamed = batch.clone().rename_key_("action", "a")
    for name in ("reward", "done", "terminated"):
        renamed.rename_key_(("next", name), ("next", names[name]))
    expected = loss(batch)
    loss.set_keys(**names)
    torch.testing.assert_close(loss(renamed), expected)
    torch.testing.assert_close(renamed["p"], batch["td_error"])
    assert batch["td_error"].shape == (BATCH, 1)
