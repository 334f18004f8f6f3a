"""Behaviour cloning with the heads of `make_actor`, against likelihoods written out."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch.nn import functional as F
from torchrl.data import Binary, Categorical, MultiCategorical, TensorSpec, Unbounded

from torchrl_tit.modules import make_actor
from torchrl_tit.objectives import LikelihoodBCLoss


@pytest.mark.parametrize(
    "spec",
    [
        Categorical(3),
        MultiCategorical([3, 2]),
        Binary(4, shape=(4,), dtype=torch.int8),
        Unbounded(2),
    ],
    ids=["categorical", "multi-categorical", "binary", "unbounded"],
)
def test_negative_log_likelihood(spec: TensorSpec) -> None:
    torch.manual_seed(0)
    actor = make_actor(8, spec).double()
    (linear,) = (m for m in actor.modules() if isinstance(m, torch.nn.Linear))
    torch.nn.init.normal_(linear.weight)
    loss = LikelihoodBCLoss(actor)
    features, action = torch.randn(5, 8, dtype=torch.float64), spec.rand((5,))
    with torch.no_grad():
        outputs = F.linear(features, linear.weight, linear.bias)
    if isinstance(spec, MultiCategorical):
        first, second = outputs.split([3, 2], -1)
        expected = F.cross_entropy(first, action[:, 0]) + F.cross_entropy(second, action[:, 1])
    elif isinstance(spec, Binary):
        bits = F.binary_cross_entropy_with_logits(outputs, action.double(), reduction="none")
        expected = bits.sum(-1).mean()
    elif isinstance(spec, Categorical):
        expected = F.cross_entropy(outputs, action)
    else:  # a standard deviation of 1 at the start
        action = action.double()
        expected = ((action - outputs) ** 2 / 2 + math.log(2 * math.pi) / 2).sum(-1).mean()
    batch = TensorDict({"features": features, "action": action}, [5])
    result = loss(batch)["loss_bc"]
    torch.testing.assert_close(result, expected)
    result.backward()
    assert set(batch.keys()) == {"features", "action"}
    assert any(weight.grad is not None for weight in loss.parameters())
