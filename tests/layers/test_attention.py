"""Self-attention of chosen positions, under chosen masks, against PyTorch's."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from tests.networks.reference import randomize
from tests.numerics import assert_near
from torchrl_tit.layers import (
    GatedTransformerBlock,
    SelfAttention,
    TransformerBlock,
    attention,
    attention_maps,
)

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

READS: list[tuple[Any, slice]] = [
    ("all", slice(None)),
    ("first", slice(0, 1)),
    ("last", slice(-1, None)),
    (slice(0, None, 2), slice(0, None, 2)),
    (slice(-2, None), slice(-2, None)),
]


def make(causal: bool, heads: int = 3, **options: Any) -> tuple[SelfAttention, Any]:
    """Ours, and PyTorch's with the same state dict."""
    ours = SelfAttention(12, heads, causal=causal, **options)
    randomize(ours)
    reference = nn.MultiheadAttention(12, heads, batch_first=True)
    reference.out_proj = nn.Linear(12, options.get("out_dim", 12))  # type: ignore[assignment]
    reference.load_state_dict(ours.state_dict())
    return ours, reference


@pytest.mark.parametrize("heads", [1, 3])
@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("length", [1, 2, 5])
@pytest.mark.parametrize("mask", ["none", "one", "for every row"])
@pytest.mark.parametrize("path", ["kernel", "dropping", "vmap on a GPU"])
def test_equals_multihead_attention(
    heads: int,
    causal: bool,
    length: int,
    mask: str,
    path: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ours, reference = make(causal, heads)
    if path == "dropping":  # with a probability that drops none
        ours.train()
        ours.dropout.p = 1e-30
    if path == "vmap on a GPU":
        monkeypatch.setattr(attention, "_has_no_kernel", lambda query: True)
    x = torch.randn(4, length, 12)
    seen = torch.ones(length, length, dtype=torch.bool)
    given: Tensor | None = None
    if mask != "none":  # it takes the place of the causal one
        rows = 4 if mask == "for every row" else 1
        given = (torch.rand(rows, 1, length, length) < 0.5) | torch.eye(length, dtype=torch.bool)
        seen = given.expand(4, heads, -1, -1).flatten(0, 1)
    elif causal:
        seen = seen.tril()
    expected, weights = reference(x, x, x, attn_mask=~seen, average_attn_weights=False)
    for read, positions in READS:
        assert_near(ours(x, read, given), expected[:, positions])
    assert_near(ours.weights(x, given), weights)
    rows_of = x.unflatten(0, (2, 2))
    assert_near(ours(rows_of, mask=given), expected.unflatten(0, (2, 2)))


@pytest.mark.parametrize("length", [1, 4])
def test_another_output_width(length: int) -> None:
    ours, reference = make(causal=False, out_dim=7)
    x = torch.randn(5, length, 12)
    assert_near(ours(x), reference(x, x, x)[0])


def test_maps_are_those_of_every_call() -> None:
    block, gated = TransformerBlock(12, 3, causal=True), GatedTransformerBlock(12, 2, 4)
    x = torch.randn(2, 5, 4, 12)

    class Twice(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.block, self.gated = block, gated

        def forward(self, x: Tensor) -> Tensor:
            return self.gated(self.block(self.block(x)), causal=True, read="last")

    first, second, last = attention_maps(Twice(), x)
    assert_near(first, block.attention.weights(block.norm1(x)))
    assert_near(second, block.attention.weights(block.norm1(block(x))))
    normal = gated.norm1(block(block(x)))
    assert_near(last, gated.attention.weights(normal, causal=True))
    assert first.shape == (2, 5, 3, 4, 4)
    assert not block.attention._forward_pre_hooks


@pytest.mark.parametrize("length", [1, 3])
@pytest.mark.parametrize("read", ["all", "first", "last"])
def test_dropout_leaves_the_mean_as_it_is(length: int, read: Any) -> None:
    attention = SelfAttention(8, 2, causal=True, dropout=0.25)
    randomize(attention)
    x = torch.randn(1, length, 8)
    expected = attention.eval()(x, read)
    many = attention.train()(x.expand(20_000, -1, -1), read)
    # The output is linear in the weights, so its mean is that without dropout.
    error = (many.mean(0) - expected[0]).abs()
    assert (many.std(0) > 1e-3).all()
    assert (error < 6 * many.std(0) / 20_000**0.5).all()
