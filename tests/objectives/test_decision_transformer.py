"""Decision Transformer's loss against its formula over unmasked actions."""

from typing import Any, Literal

import pytest
import torch
from torch.nn import functional as F
from torchrl.objectives import DTLoss, OnlineDTLoss

from tests.modules import test_decision_transformer as small
from torchrl_tit.modules import make_dt_actor, make_dt_predictor
from torchrl_tit.objectives import MaskedDTLoss

pytestmark = pytest.mark.numerics


def make_network(**settings: Any) -> Any:
    """In double precision, so that what must be equal is equal on any processor."""
    return tuple(module.double() for module in small.make_network(**settings))


def make_batch(**settings: Any) -> Any:
    batch = small.make_batch(**settings)
    return batch.apply(lambda x: x.double() if x.is_floating_point() else x)


def test_mean_squared_error_of_unmasked_actions():
    (network, head), batch = make_network(), make_batch()
    predictor = make_dt_predictor(network, head)
    loss = MaskedDTLoss(predictor)
    predicted, mask = predictor(batch.clone())["action"], batch["mask"]
    expected = (predicted - batch["action"])[mask].square().mean()
    before = batch.clone()
    torch.testing.assert_close(loss(batch)["loss"], expected)
    assert (batch == before).all()
    assert not torch.isclose(DTLoss(predictor)(batch)["loss"], expected)  # it counts padding


@pytest.mark.parametrize("kind", ["discrete", "one-hot"])
@pytest.mark.parametrize("reduction", ["sum", None])
def test_cross_entropy_of_unmasked_actions(kind, reduction):
    (network, head), batch = make_network(space="discrete"), make_batch(kind=kind)
    predictor = make_dt_predictor(network, head)
    loss = MaskedDTLoss(predictor, loss_function="cross_entropy", reduction=reduction)
    logits, mask = predictor(batch.clone())["action"], batch["mask"]
    target = batch["action"].argmax(-1) if kind == "one-hot" else batch["action"]
    expected = F.cross_entropy(logits[mask], target[mask], reduction=reduction or "mean")
    torch.testing.assert_close(loss(batch)["loss"], expected)


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("space", ["continuous", "discrete", "gaussian"])
def test_padding_has_no_influence(space):
    """Neither on the loss nor on any gradient, whatever stands there."""
    kind = "discrete" if space == "discrete" else "continuous"
    (network, head), batch = make_network(space=space), make_batch(kind=kind)
    trained: Any = torch.nn.ModuleList([network, head])
    if space == "gaussian":
        actor = make_dt_actor(network, head, group=None, every_frame=True)
        loss = OnlineDTLoss(actor, target_entropy=-3.0)
        loss.loss_mask_key = "mask"
        batch["action"].clamp_(-0.99, 0.99)
    else:
        function: Literal["cross_entropy", "l2"] = "cross_entropy" if space == "discrete" else "l2"
        loss = MaskedDTLoss(make_dt_predictor(network, head), loss_function=function)
    other, padding = batch.clone(), ~batch["mask"]
    other["observation"][padding] = 3.0
    other["return_to_go"][padding] = 7.0
    other["timestep"][padding] = 4
    other["action"][padding] = 0.5 if kind == "continuous" else 2
    results = []
    for given in (batch, other):
        trained.zero_grad()
        torch.manual_seed(0)
        terms = loss(given)
        name = "loss_log_likelihood" if space == "gaussian" else "loss"
        terms[name].backward()
        results.append([terms[name].detach(), *(p.grad.clone() for p in trained.parameters())])
    torch.testing.assert_close(results[0], results[1])
    assert any(gradient.any() for gradient in results[0][1:])


@pytest.mark.parametrize("kind", ["continuous", "discrete", "one-hot"])
def test_actions_of_the_other_kind_are_refused(kind):
    """One-hot vectors and logits have a squared error, too, and the largest entry an index."""
    discrete = kind != "continuous"
    predictor = make_dt_predictor(*make_network(space="discrete" if discrete else kind))
    loss = MaskedDTLoss(predictor, loss_function="l2" if discrete else "cross_entropy")
    message = "'l2' .*int64: take 'cross_ent" if discrete else "'cross_.*float64: .* 'l2', "
    with pytest.raises(TypeError, match=message):
        loss(make_batch(kind=kind))


@pytest.mark.parametrize("space", ["continuous", "discrete"])
def test_a_batch_without_a_mask_is_refused(space):
    """Otherwise, its padding would count."""
    function: Literal["cross_entropy", "l2"] = "cross_entropy" if space == "discrete" else "l2"
    predictor = make_dt_predictor(*make_network(space=space))
    batch = make_batch(kind=space)
    with pytest.raises(KeyError, match=r"no mask 'mask', only \['action', .*False at padding"):
        MaskedDTLoss(predictor, loss_function=function)(batch.exclude("mask"))
    with pytest.raises(KeyError, match="no mask 'valid'"):
        MaskedDTLoss(predictor, loss_function=function, mask_key="valid")(batch)
