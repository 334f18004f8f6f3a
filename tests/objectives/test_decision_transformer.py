"""Decision Transformer's loss against the formula, padding left out."""

import pytest
import torch
from torch.nn import functional as F
from torchrl.objectives import DTLoss, OnlineDTLoss

from tests.modules.test_decision_transformer import make_batch, make_network
from torchrl_tit.modules import make_dt_actor, make_dt_predictor
from torchrl_tit.objectives import MaskedDTLoss


def test_mean_squared_error_of_unmasked_actions():
    network, batch = make_network(), make_batch()
    predictor = make_dt_predictor(network)
    loss = MaskedDTLoss(predictor)
    predicted, mask = predictor(batch.clone())["action"], batch["mask"]
    expected = (predicted - batch["action"])[mask].square().mean()
    before = batch.clone()
    torch.testing.assert_close(loss(batch)["loss"], expected)
    assert (batch == before).all()
    assert not torch.isclose(DTLoss(predictor)(batch)["loss"], expected)  # it counts padding


@pytest.mark.parametrize("kind", ["discrete", "one-hot"])
@pytest.mark.parametrize("reduction", ["mean", "sum"])
def test_cross_entropy_of_unmasked_actions(kind, reduction):
    network, batch = make_network(action_space="discrete"), make_batch(kind=kind)
    predictor = make_dt_predictor(network)
    loss = MaskedDTLoss(predictor, loss_function="cross_entropy", reduction=reduction)
    logits, mask = predictor(batch.clone())["action"], batch["mask"]
    target = batch["action"].argmax(-1) if kind == "one-hot" else batch["action"]
    expected = F.cross_entropy(logits[mask], target[mask], reduction=reduction)
    torch.testing.assert_close(loss(batch)["loss"], expected)


@pytest.mark.parametrize("space", ["continuous", "discrete", "gaussian"])
def test_padding_has_no_influence(space):
    """Neither on the loss nor on any gradient, whatever stands there."""
    kind = "discrete" if space == "discrete" else "continuous"
    network, batch = make_network(action_space=space), make_batch(kind=kind)
    if space == "gaussian":
        loss = OnlineDTLoss(make_dt_actor(network, group=None, newest=False), target_entropy=-3.0)
        loss.loss_mask_key = "mask"
        batch["action"].clamp_(-0.99, 0.99)
    else:
        function = "cross_entropy" if space == "discrete" else "l2"
        loss = MaskedDTLoss(make_dt_predictor(network), loss_function=function)
    other, padding = batch.clone(), ~batch["mask"]
    other["observation"][padding] = 3.0
    other["return_to_go"][padding] = 7.0
    other["timestep"][padding] = 4
    other["action"][padding] = 0.5 if kind == "continuous" else 2
    results = []
    for given in (batch, other):
        network.zero_grad()
        torch.manual_seed(0)
        terms = loss(given)
        name = "loss_log_likelihood" if space == "gaussian" else "loss"
        terms[name].backward()
        results.append([terms[name].detach(), *(p.grad.clone() for p in network.parameters())])
    torch.testing.assert_close(results[0], results[1], rtol=1e-5, atol=1e-6)
    assert any(gradient.any() for gradient in results[0][1:])


def test_gradients_reach_every_weight_and_train_them():
    network, batch = make_network(state_encoder="inner_transformer"), make_batch(batch=16)
    loss = MaskedDTLoss(make_dt_predictor(network))
    optimizer = torch.optim.AdamW(network.parameters(), lr=3e-3)
    first = loss(batch)["loss"]
    first.backward()
    without = {n for n, p in network.named_parameters() if p.grad is None or not p.grad.any()}
    assert without == set()
    for _ in range(60):
        optimizer.zero_grad()
        loss(batch)["loss"].backward()
        optimizer.step()
    assert loss(batch)["loss"] < first / 3


@pytest.mark.parametrize("kind", ["continuous", "discrete", "one-hot"])
def test_actions_of_the_other_kind_are_refused(kind):
    """One-hot vectors and logits have a squared error, too, and the largest entry an index."""
    discrete = kind != "continuous"
    predictor = make_dt_predictor(make_network(action_space="discrete" if discrete else kind))
    loss = MaskedDTLoss(predictor, loss_function="l2" if discrete else "cross_entropy")
    message = "'l2' .*int64: take 'cross_ent" if discrete else r"'cross_.*float32: .* \('l2', "
    with pytest.raises(TypeError, match=message):
        loss(make_batch(kind=kind))


def test_an_unknown_loss_function_is_refused_at_once():
    predictor = make_dt_predictor(make_network())
    with pytest.raises(ValueError, match=r"unknown loss_function 'l3': choose one of \('l2', "):
        MaskedDTLoss(predictor, loss_function="l3")
