"""Relative biases and rotations within attention, against loops over pairs of steps."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.networks.reference import randomize
from tests.numerics import assert_near
from torchrl_tit.layers import SelfAttention
from torchrl_tit.settings import TemporalPositions

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

WIDTH, HEADS, STEPS = 12, 3, 5
KINDS: list[TemporalPositions] = ["relative", "rotary"]
each_kind = pytest.mark.parametrize("kind", KINDS)


def make(kind: TemporalPositions, num_frames: int = STEPS) -> SelfAttention:
    attention = SelfAttention(WIDTH, HEADS, causal=True, positions=kind, num_frames=num_frames)
    randomize(attention)
    return attention.eval()


def turned(x: Tensor, step: int) -> Tensor:
    """RoPE: pairs of entries as complex numbers, each turned by its own angle at every step."""
    half = len(x) // 2
    angles = torch.tensor([step / 10_000 ** (pair / half) for pair in range(half)])
    pairs = torch.complex(x[:half], x[half:]) * torch.polar(torch.ones(half), angles)
    return torch.cat([pairs.real, pairs.imag])


def written_out(attention: SelfAttention, x: Tensor) -> tuple[Tensor, Tensor]:
    """Output [S, D] and weights [heads, S, S], one pair of steps and one head at a time."""
    steps, size = len(x), WIDTH // HEADS
    q, k, v = (x @ attention.in_proj_weight.T + attention.in_proj_bias).chunk(3, dim=-1)

    def score(h: int, i: int, j: int) -> Tensor:
        own = slice(h * size, (h + 1) * size)
        if attention.rotary is not None:
            return turned(q[i, own], i) @ turned(k[j, own], j) / math.sqrt(size)
        assert attention.relative is not None
        return q[i, own] @ k[j, own] / math.sqrt(size) + attention.relative.bias[h, i - j]

    def row(h: int, i: int) -> Tensor:
        seen = torch.stack([score(h, i, j) for j in range(i + 1)]).softmax(0)
        return torch.cat([seen, torch.zeros(steps - 1 - i)])

    weights = torch.stack([torch.stack([row(h, i) for i in range(steps)]) for h in range(HEADS)])
    mixed = [weights[h] @ v[:, h * size : (h + 1) * size] for h in range(HEADS)]
    return attention.out_proj(torch.cat(mixed, dim=-1)), weights


@each_kind
@pytest.mark.parametrize("length", [1, 4, STEPS])
@pytest.mark.parametrize("dropping", [False, True])
def test_attention_is_the_equation(kind: TemporalPositions, length: int, dropping: bool) -> None:
    attention = make(kind)
    if dropping:  # the path that drops weights, with a probability that drops none
        attention.train()
        attention.dropout.p = 1e-30
    x = torch.randn(2, length, WIDTH)
    rows = [written_out(attention, row) for row in x]
    expected = torch.stack([out for out, _ in rows])
    assert_near(attention(x), expected)
    assert_near(attention(x, "last"), expected[:, -1:])
    assert_near(attention(x, "first"), expected[:, :1])
    assert_near(attention(x, slice(0, None, 2)), expected[:, ::2])
    assert_near(attention.weights(x), torch.stack([weights for _, weights in rows]))


@each_kind
@pytest.mark.parametrize("read", ["all", "last"])
def test_gradients_are_those_of_the_equation(kind: TemporalPositions, read: Any) -> None:
    attention = make(kind)
    x = torch.randn(STEPS, WIDTH, requires_grad=True)
    positions = slice(None) if read == "all" else slice(-1, None)
    inputs = [x, *attention.parameters()]
    probe = torch.randn(STEPS, WIDTH)[positions]
    actual = torch.autograd.grad((attention(x[None], read)[0] * probe).sum(), inputs)
    expected = torch.autograd.grad((written_out(attention, x)[0][positions] * probe).sum(), inputs)
    assert_near(list(actual), list(expected))
