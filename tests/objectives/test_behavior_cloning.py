"""Behavior cloning with the heads of `make_actor`, against likelihoods written out."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.nn import functional as F
from torchrl.data import Binary, Bounded, Categorical, MultiCategorical, TensorSpec, Unbounded
from torchrl.modules import Actor, ProbabilisticActor, TanhDelta

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
    (linear,) = (m for m in actor.modules() if isinstance(m, nn.Linear))
    nn.init.normal_(linear.weight)
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


@pytest.mark.parametrize(("spec", "shape"), [(Unbounded(2), (5, 1, 2)), (Categorical(3), (5, 1))])
def test_actions_that_would_be_broadcast_are_refused(spec, shape):
    loss = LikelihoodBCLoss(make_actor(8, spec))
    batch = TensorDict({"features": torch.randn(5, 8), "action": torch.ones(shape)}, [5])
    with pytest.raises(
        ValueError, match=r"'action' has the shape \[5, 1.*actions have \[5.*reshape"
    ):
        loss(batch)


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_padding_does_not_count(reduction):
    """Under the key of TorchRL's `BCLoss`, and with its results."""
    actor = make_actor(8, Categorical(3)).double()
    loss = LikelihoodBCLoss(actor, reduction=reduction)
    loss.set_keys(pad_mask="padding")
    padding = torch.arange(6).expand(4, 6) >= torch.tensor([[2], [6], [5], [0]])
    features = torch.randn(4, 6, 8, dtype=torch.float64, requires_grad=True)
    action = torch.randint(3, (4, 6))
    batch = TensorDict({"features": features, "action": action, "padding": padding}, [4])
    result = loss(batch)["loss_bc"]
    logits = actor(batch.copy())["logits"]
    expected = F.cross_entropy(logits[~padding], action[~padding], reduction=reduction)
    torch.testing.assert_close(result, expected)
    result.sum().backward()
    assert features.grad is not None
    assert torch.equal(features.grad.any(-1), ~padding)
    with pytest.raises(KeyError, match="padding"):
        loss(batch.exclude("padding"))


@pytest.mark.parametrize("kind", ["Actor", "ProbabilisticActor"])
def test_deterministic_policies_are_refused(kind):
    """TorchRL's have a distribution, too, in which every action of the data is impossible."""
    linear, spec = nn.Linear(4, 2), Bounded(-1, 1, (2,))
    actor = Actor(linear, spec=spec)
    if kind == "ProbabilisticActor":
        module = TensorDictModule(linear, ["observation"], ["param"])
        actor = ProbabilisticActor(
            module, in_keys=["param"], spec=spec, distribution_class=TanhDelta
        )
    with pytest.raises(ValueError, match=f"not the deterministic {kind}, .*BCLoss") as error:
        LikelihoodBCLoss(actor)
    assert "\n" not in str(error.value)
