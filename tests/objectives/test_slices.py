"""The loss of slices of consecutive transitions is that of the transitions one by one."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import nn
from torchrl.data import Bounded, Categorical
from torchrl.modules import MLP, QValueModule, ValueOperator
from torchrl.objectives import LossModule

from torchrl_tit.datasets import HistoryStorage, episodes_from_arrays
from torchrl_tit.modules import Backbone, make_squashed_actor
from torchrl_tit.networks import build_network
from torchrl_tit.objectives import ContinuousCQLLoss, DelayedDiscreteCQLLoss
from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import enhanced_tit, lstm, mlp

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

FRAMES, SIZE, STEPS, WIDTH = 4, 6, 40, 8
NETWORKS = {
    "enhanced": enhanced_tit(FRAMES, embed_dim=WIDTH, features_dim=WIDTH),
    "lstm": lstm(FRAMES, embed_dim=WIDTH, hidden_dim=WIDTH, features_dim=WIDTH),
    "mlp": mlp(FRAMES, hidden_dim=WIDTH),
}


def draw(length: int, padding: Any, discrete: bool) -> TensorDictBase:
    """All steps of short episodes, some terminated: [STEPS], or slices [STEPS / length, length]."""
    generator = torch.Generator().manual_seed(0)
    observations, last = (torch.randn(STEPS, SIZE, generator=generator) for _ in range(2))
    ends = torch.arange(STEPS) % 7 == 6
    terminals = ends & (torch.arange(STEPS) % 2 == 0)
    following = torch.cat([observations[1:], last[:1]])
    following[ends] = last[ends]
    actions = torch.rand(STEPS, 2, generator=generator) * 2 - 1
    if discrete:
        actions = torch.randint(3, (STEPS,), generator=generator)
    episodes = episodes_from_arrays(
        observations, actions, torch.randn(STEPS), terminals, ends & ~terminals, following
    )
    storage = HistoryStorage(
        episodes, FRAMES, padding=padding, unfinished="keep", is_init=length > 1
    )
    index = torch.arange(STEPS)
    batch = storage[index if length == 1 else index.view(-1, length)]
    assert length == 1 or batch["is_init"][:, 1:].any()  # ends within slices
    return batch.apply(lambda x: x.double() if x.is_floating_point() else x)


def backbone(network: Network, slices: bool, out_key: str = "features") -> Backbone:
    trunk = build_network(network, (SIZE,), trunks="shared")
    keys = ["observation"] if slices else None
    return Backbone(trunk, out_keys=[out_key], observation_keys=keys)


def continuous(network: Network, slices: bool) -> LossModule:
    spec = Bounded(-torch.ones(2), torch.ones(2), shape=(2,))
    critics = []
    for _ in range(2):
        first = backbone(network, slices, "critic_features")
        q = MLP(first.features_dim + 2, 1, num_cells=[8])
        last = ValueOperator(q, in_keys=["critic_features", "action"])
        critics.append(TensorDictSequential(first, last))
    first = backbone(network, slices)
    actor = ProbabilisticTensorDictSequential(first, *make_squashed_actor(first.features_dim, spec))
    return ContinuousCQLLoss(actor, critics, action_spec=spec, num_random=3)


def discrete(network: Network, slices: bool) -> LossModule:
    first = backbone(network, slices)
    head = TensorDictModule(nn.Linear(first.features_dim, 3), ["features"], ["action_value"])
    policy = TensorDictSequential(first, head, QValueModule(spec=Categorical(3)))
    return DelayedDiscreteCQLLoss(policy, action_space="categorical")


@pytest.mark.parametrize(
    ("make", "name", "length", "padding"),
    [
        (continuous, "enhanced", 4, "same"),
        (continuous, "enhanced", 8, "constant"),
        (continuous, "lstm", 8, "same"),
        (continuous, "mlp", 4, "same"),
        (discrete, "enhanced", 4, "constant"),
        (discrete, "mlp", 8, "same"),
    ],
)
def test_loss_and_gradients(make: Any, name: str, length: int, padding: Any) -> None:
    results = []
    for size in (1, length):
        torch.manual_seed(0)
        loss = make(NETWORKS[name], size > 1)
        loss.make_value_estimator(gamma=0.9)
        torch.manual_seed(1)
        terms = loss(draw(size, padding, make is discrete))
        losses = [terms[key] for key in loss.out_keys if key.startswith("loss_")]
        params = list(loss.parameters())
        gradients = torch.autograd.grad(sum(losses), params, materialize_grads=True)
        results.append([*losses, *gradients])
    assert any(gradient.abs().max() > 1e-3 for gradient in results[0][4:])
    torch.testing.assert_close(results[1], results[0], rtol=1e-9, atol=1e-9)
