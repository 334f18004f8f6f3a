"""CoBERL's contrastive loss equals its formula, written out step by step."""

import math

import pytest
import torch

from torchrl_tit.objectives import contrastive_prediction_loss


def by_hand(encodings, predictions, mask, temperature):
    x, y = predictions.flatten(0, 1), encodings.flatten(0, 1)

    def s(a, b):
        return torch.dot(a, b).item() / (a.norm() * b.norm()).item() / temperature

    losses = []
    for t in mask.flatten().nonzero().flatten().tolist():
        forward = [math.exp(s(x[t], y_i)) for y_i in y]
        backward = [math.exp(s(y[t], x_i)) for x_i in x]
        p = [value / sum(forward) for value in forward]
        q = [value / sum(backward) for value in backward]
        divergence = sum(b * math.log(b / a) for a, b in zip(p, q, strict=True))
        losses.append(-math.log(p[t]) - math.log(q[t]) + divergence)
    return sum(losses) / len(losses)


@pytest.mark.numerics
@pytest.mark.parametrize("temperature", [0.1, 1.0])
def test_equals_the_formula(temperature):
    torch.manual_seed(0)
    encodings, predictions = torch.randn(2, 3, 4, 5)
    mask = torch.tensor([[True, False, False, True], [False] * 4, [False, True, False, False]])
    loss = contrastive_prediction_loss(encodings, predictions, mask, temperature=temperature)
    assert loss.item() == pytest.approx(
        by_hand(encodings, predictions, mask, temperature), rel=1e-5
    )


def test_the_loss_is_zero_without_masked_steps():
    tensors = torch.randn(2, 2, 3, 4, requires_grad=True)
    mask = torch.zeros(2, 3, dtype=torch.bool)
    loss = contrastive_prediction_loss(tensors[0], tensors[1], mask)
    assert loss == 0
    (gradient,) = torch.autograd.grad(loss, tensors)
    assert not gradient.any()
