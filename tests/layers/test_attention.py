"""Self-attention of chosen positions, under chosen masks, of a chosen output width."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from tests.networks.reference import randomize
from tests.numerics import assert_near
from torchrl_tit.layers import SelfAttention

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

SEEN = torch.tensor(
    [[1, 0, 0, 0], [1, 1, 0, 1], [0, 0, 1, 0], [1, 1, 1, 1]], dtype=torch.bool
)  # row sees column


def make(causal: bool, out_dim: int | None = None) -> tuple[SelfAttention, nn.MultiheadAttention]:
    ours = SelfAttention(12, 3, causal=causal, out_dim=out_dim)
    randomize(ours)
    reference = nn.MultiheadAttention(12, 3, batch_first=True)
    reference.out_proj = nn.Linear(12, out_dim or 12)  # type: ignore[assignment]
    reference.load_state_dict(ours.state_dict())
    return ours, reference


def expect(reference: nn.MultiheadAttention, x: Tensor, seen: Tensor) -> Tensor:
    return reference(x, x, x, attn_mask=~seen)[0]


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("read", [slice(None), slice(1, None, 2), slice(-1, None), slice(0, 2)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("dropping", [False, True])
def test_slices_and_masks(causal: bool, read: slice, masked: bool, dropping: bool) -> None:
    ours, reference = make(causal)
    if dropping:  # the path that drops weights, with a probability that drops none
        ours.train()
        ours.dropout.p = 1e-30
    x = torch.randn(5, 4, 12)
    everything = torch.ones(4, 4, dtype=torch.bool)
    seen = SEEN if masked else everything.tril() if causal else everything
    features = ours(x, read, SEEN if masked else None)
    assert_near(features, expect(reference, x, seen)[:, read])


@pytest.mark.parametrize("read", ["all", "first", "last"])
def test_names_equal_slices(read: str) -> None:
    ours, reference = make(causal=True)
    x = torch.randn(5, 4, 12)
    positions = {"all": slice(None), "first": slice(0, 1), "last": slice(-1, None)}[read]
    expected = expect(reference, x, torch.ones(4, 4, dtype=torch.bool).tril())[:, positions]
    assert_near(ours(x, read), expected)


@pytest.mark.parametrize("length", [2, 5])
@pytest.mark.parametrize("dropping", [False, True])
def test_a_first_position_that_all_sequences_share(length: int, dropping: bool) -> None:
    ours, _ = make(causal=False)
    if dropping:
        ours.train()
        ours.dropout.p = 1e-30
    first, rest = torch.randn(1, 1, 12), torch.randn(5, length - 1, 12)
    results = []
    for joined in (False, True):
        inputs = [first.clone().requires_grad_(), rest.clone().requires_grad_()]
        if joined:
            out = ours(torch.cat([inputs[0].expand(5, 1, 12), inputs[1]], dim=1), "first")
        else:
            out = ours.read_first(*inputs)
        weights = torch.arange(out.numel()).view_as(out) / out.numel()
        results.append(
            [out, *torch.autograd.grad((out * weights).sum(), [*inputs, *ours.parameters()])]
        )
    for own, expected in zip(*results, strict=True):
        assert_near(own, expected)


def test_a_mask_for_every_row() -> None:
    ours, reference = make(causal=False)
    x = torch.randn(2, 4, 12)
    masks = torch.stack([SEEN, torch.eye(4, dtype=torch.bool)])
    expected = torch.cat([expect(reference, x[i : i + 1], masks[i]) for i in range(2)])
    assert_near(ours(x, mask=masks[:, None]), expected)


@pytest.mark.parametrize("length", [1, 4])
def test_another_output_width(length: int) -> None:
    ours, reference = make(causal=False, out_dim=7)
    x = torch.randn(5, length, 12)
    features = ours(x)
    assert features.shape == (5, length, 7)
    assert_near(features, expect(reference, x, torch.ones(length, length) > 0))


def test_one_position_attends_to_itself_under_dropout() -> None:
    """A weight of 1, dropped with the probability p in each head, or scaled by 1 / (1 - p)."""
    torch.manual_seed(0)
    attention = SelfAttention(8, 2, causal=True, dropout=0.4)
    attention.out_proj = nn.Identity()  # type: ignore[assignment]
    x = torch.randn(2000, 1, 8)
    value = attention.eval()(x).unflatten(-1, (2, 4))
    heads = attention.train()(x).unflatten(-1, (2, 4))
    dropped = (heads == 0).all(-1)
    torch.testing.assert_close(heads[~dropped], value[~dropped] / 0.6, rtol=1e-4, atol=1e-6)
    assert dropped.float().mean().item() == pytest.approx(0.4, abs=0.03)
    assert not torch.equal(dropped[..., 0], dropped[..., 1])
