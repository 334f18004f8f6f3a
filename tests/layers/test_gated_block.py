"""Relative attention, gate and gated block against PyTorch's layers and equations written out."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn

from tests.networks.reference import randomize
from tests.numerics import assert_near
from torchrl_tit.layers import GatedTransformerBlock, GRUGate, RelativeSelfAttention

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


@pytest.mark.parametrize("causal", [True, False])
def test_relative_attention_without_distances_is_multihead_attention(causal: bool) -> None:
    attention, reference = RelativeSelfAttention(12, 3, 5), nn.MultiheadAttention(12, 3, bias=False)
    nn.init.zeros_(attention.distance_key.weight)
    assert reference.in_proj_weight is not None
    reference.in_proj_weight.data.copy_(attention.query_key_value.weight)
    reference.out_proj.weight.data.copy_(attention.out_proj.weight)
    x = torch.randn(5, 2, 12)
    unseen = torch.ones(5, 5, dtype=torch.bool).triu(1) if causal else None
    expected, weights = reference(x, x, x, attn_mask=unseen, average_attn_weights=False)
    x = x.transpose(0, 1)
    assert_near(attention(x, causal=causal), expected.transpose(0, 1))
    assert_near(attention.weights(x, causal=causal), weights)


def test_gate_is_a_gru_with_a_bias() -> None:
    gate = GRUGate(6, bias=0.7)
    gru = nn.GRUCell(6, 6)
    # PyTorch's update gate z keeps the state: its sign is turned.
    gru.weight_ih.data.copy_(
        torch.cat([gate.reset_y.weight, -gate.update_y.weight, gate.candidate_y.weight])
    )
    gru.weight_hh.data.copy_(
        torch.cat([gate.reset_x.weight, -gate.update_x.weight, gate.candidate_x.weight])
    )
    nn.init.zeros_(gru.bias_hh)
    gru.bias_ih.data.copy_(torch.tensor([0.0, 0.7, 0.0]).repeat_interleave(6))
    # It multiplies the state after the projection, ours before it, as the paper: alike where the
    # reset gate is the same number for all entries.
    nn.init.zeros_(gate.reset_x.weight)
    nn.init.zeros_(gate.reset_y.weight)
    gru.weight_ih.data[:6] = 0
    gru.weight_hh.data[:6] = 0
    x, y = torch.randn(5, 6), torch.randn(5, 6)
    assert_near(gate(x, y), gru(y, x))


def test_gate_resets_the_stream_before_its_projection() -> None:
    gate = GRUGate(4)
    randomize(gate)
    x, y = torch.randn(3, 4), torch.randn(3, 4)
    w = {name: p for name, p in gate.named_parameters()}
    r = torch.sigmoid(y @ w["reset_y.weight"].T + x @ w["reset_x.weight"].T)
    z = torch.sigmoid(y @ w["update_y.weight"].T + x @ w["update_x.weight"].T - w["bias"])
    h = torch.tanh(y @ w["candidate_y.weight"].T + (r * x) @ w["candidate_x.weight"].T)
    assert_near(gate(x, y), (1 - z) * x + z * h)


def test_block_gates_rectified_updates() -> None:
    block = GatedTransformerBlock(12, 3, 4)
    randomize(block)
    x = torch.randn(2, 4, 12)
    y = block.gate1(x, block.attention(block.norm1(x), causal=True).clamp(min=0))
    expected = block.gate2(y, block.ffn(block.norm2(y)).clamp(min=0))
    torch.testing.assert_close(block(x, causal=True), expected)
