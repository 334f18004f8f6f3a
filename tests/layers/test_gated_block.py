"""Relative attention, gate and gated block against their equations, written out."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from tests.networks.reference import randomize
from tests.numerics import assert_near
from torchrl_tit.layers import GRUGate, RelativeSelfAttention

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]


def encoding(distance: int, dim: int) -> Tensor:
    """Transformer-XL's sinusoids of a distance."""
    angles = [distance / 10_000 ** (i / dim) for i in range(0, dim, 2)]
    return torch.tensor([math.sin(a) for a in angles] + [math.cos(a) for a in angles])


def written_out(attention: RelativeSelfAttention, x: Tensor, causal: bool) -> Tensor:
    """The equation of Transformer-XL, one pair of steps and one head at a time."""
    (steps, dim), heads = x.shape, attention.num_heads
    size = dim // heads
    w_q, w_k, w_v = attention.query_key_value.weight.chunk(3)
    outputs = torch.zeros(steps, dim)
    for h in range(heads):
        rows = slice(h * size, (h + 1) * size)
        u, v = attention.content_bias[h, 0], attention.distance_bias[h, 0]
        for i in range(steps):
            query = w_q[rows] @ x[i]
            seen = range(i + 1) if causal else range(steps)
            scores = torch.stack(
                [
                    (query + u) @ (w_k[rows] @ x[j])
                    + (query + v) @ (attention.distance_key.weight[rows] @ encoding(i - j, dim))
                    for j in seen
                ]
            )
            weights = (scores / math.sqrt(size)).softmax(0)
            outputs[i, rows] = sum(
                (weights[n] * (w_v[rows] @ x[j]) for n, j in enumerate(seen)), torch.zeros(size)
            )
    return outputs @ attention.out_proj.weight.T


@pytest.mark.parametrize("causal", [True, False])
@pytest.mark.parametrize("num_frames", [1, 4])
def test_relative_attention_is_the_equation(causal: bool, num_frames: int) -> None:
    attention = RelativeSelfAttention(12, 3, num_frames)
    randomize(attention)
    x = torch.randn(2, num_frames, 12)
    expected = torch.stack([written_out(attention, row, causal) for row in x])
    assert_near(attention(x, causal=causal), expected)


def test_gate_is_the_equation() -> None:
    gate = GRUGate(4, bias=0.7)
    assert (gate.bias == 0.7).all()
    randomize(gate)
    x, y = torch.randn(3, 4), torch.randn(3, 4)
    w = {name: p for name, p in gate.named_parameters()}
    r = torch.sigmoid(y @ w["reset_y.weight"].T + x @ w["reset_x.weight"].T)
    z = torch.sigmoid(y @ w["update_y.weight"].T + x @ w["update_x.weight"].T - w["bias"])
    h = torch.tanh(y @ w["candidate_y.weight"].T + (r * x) @ w["candidate_x.weight"].T)
    assert_near(gate(x, y), (1 - z) * x + z * h)
