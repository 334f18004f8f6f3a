"""Our dropout has the distribution, modes and gradients of PyTorch's; and the Gaussian head."""

import torch
from torch import nn

from torchrl_tit.layers import Dropout
from torchrl_tit.layers.gaussian_head import GaussianHead


def test_drops_with_its_probability_and_keeps_the_mean() -> None:
    torch.manual_seed(0)
    x = torch.full((400, 1000), 3.0)
    for p in (0.1, 0.25, 0.9):
        y = Dropout(p)(x)
        kept = y != 0
        assert abs(kept.float().mean().item() - (1 - p)) < 5 * (p * (1 - p) / x.numel()) ** 0.5
        # Shares are multiples of 1/65536.
        expected = torch.full_like(y[kept], 3 / (1 - p))
        torch.testing.assert_close(y[kept], expected, rtol=1e-4, atol=0)
        assert abs(y.mean().item() / 3 - 1) < 5 * (p / (1 - p) / x.numel()) ** 0.5
        rows = kept.float().mean(1)  # entries are independent of their place
        assert abs(rows.var().item() / (p * (1 - p) / 1000) - 1) < 0.4


def test_gradient_is_zero_where_it_dropped() -> None:
    x = torch.randn(50, 50, requires_grad=True)
    y = Dropout(0.5)(x)
    y.sum().backward()
    assert x.grad is not None
    assert torch.equal(x.grad, torch.where(y == 0, 0.0, 2.0))


def test_does_nothing_in_evaluation_or_without_probability() -> None:
    x = torch.randn(10)
    assert torch.equal(Dropout(0.5).eval()(x), x)
    before = torch.get_rng_state()
    assert torch.equal(Dropout(0.0)(x), x)
    assert torch.equal(torch.get_rng_state(), before)  # and draws nothing
    assert isinstance(Dropout(0.5), nn.Dropout)  # TorchRL's losses look for that


def test_any_size_type_and_probability() -> None:
    for size in (0, 1, 3, 5):
        assert Dropout(0.5)(torch.ones(size)).shape == (size,)
    y = Dropout(0.5)(torch.ones(1000, dtype=torch.bfloat16))
    assert y.dtype == torch.bfloat16
    assert set(y.unique().tolist()) == {0.0, 2.0}
    assert not Dropout(1.0)(torch.ones(100)).any()
    assert Dropout(1 - 1e-9)(torch.ones(100)).isfinite().all()


def test_vmap_and_compile_take_it() -> None:
    dropout = Dropout(0.5)
    masks = torch.vmap(dropout, randomness="different")(torch.ones(8, 100))
    assert len({tuple(mask.tolist()) for mask in masks}) == 8
    compiled = torch.compile(dropout, fullgraph=True, backend="aot_eager")
    assert set(compiled(torch.ones(1000)).unique().tolist()) == {0.0, 2.0}
    torch.compiler.reset()


def test_gaussian_head_starts_orthogonal_and_is_bounded() -> None:
    head = GaussianHead(32, 3)
    for layer in (head.mean, head.log_std):
        torch.testing.assert_close(layer.weight @ layer.weight.T, torch.eye(3))
        assert not layer.bias.any()
    mean, std = head(1e6 * torch.randn(100, 32))
    torch.testing.assert_close(std.log().min(), torch.tensor(-5.0))
    torch.testing.assert_close(std.log().max(), torch.tensor(2.0))
    assert mean.abs().max() > 1e5
    torch.testing.assert_close(head(torch.zeros(32))[1], torch.full((3,), -1.5).exp())
