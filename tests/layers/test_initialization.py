"""The two initializations of the experiments, and what layers draw by themselves."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from torchrl_tit.layers import (
    ArrayPatchEmbedding,
    ImagePatchEmbedding,
    SelfAttention,
    init_orthogonal_,
)
from torchrl_tit.networks import EnhancedTIT, VanillaTIT

KINDS = pytest.mark.parametrize("kind", [EnhancedTIT, VanillaTIT])
SHAPES = pytest.mark.parametrize(("shape", "patch_size"), [((12,), 1), ((24, 24), 12)])


def make(kind: type[Any], shape: tuple[int, ...], patch_size: int) -> nn.Module:
    return kind(shape, 4, patch_size=patch_size, embed_dim=64, temporal_positions="learned")


def assert_normal(weight: Tensor, std: float) -> None:
    error = 5 * std / math.sqrt(weight.numel())
    assert abs(weight.mean().item()) < error
    assert abs(weight.std().item() - std) < error
    if weight.numel() > 1000:
        assert weight.abs().max() > 2.5 * std, "truncated"


def assert_uniform(weight: Tensor, bound: float) -> None:
    assert weight.abs().max() <= bound
    assert abs(weight.std().item() - bound / math.sqrt(3)) < 5 * bound / math.sqrt(weight.numel())


@KINDS
@SHAPES
def test_networks_start_as_the_authors(
    kind: type[Any], shape: tuple[int, ...], patch_size: int
) -> None:
    network = make(kind, shape, patch_size)
    for module in network.modules():
        if isinstance(module, nn.Linear):
            assert_normal(module.weight, 0.02)
            assert not module.bias.any()
        if isinstance(module, nn.LayerNorm):
            assert (module.weight == 1).all()
            assert not module.bias.any()
        if isinstance(module, ArrayPatchEmbedding | ImagePatchEmbedding):
            # PyTorch's default of a convolution: uniform within 1 / sqrt(inputs).
            assert_uniform(module.weight, 1 / math.sqrt(module.weight[0].numel()))
        if isinstance(module, SelfAttention):
            assert_uniform(module.in_proj_weight, math.sqrt(6 / sum(module.in_proj_weight.shape)))
            assert not module.in_proj_bias.any()
    positions = {n: p for n, p in network.named_parameters() if "position" in n or "token" in n}
    assert len(positions) == 3
    for parameter in positions.values():
        assert_normal(parameter, 0.02)


@KINDS
@SHAPES
@pytest.mark.parametrize("gain", [math.sqrt(2), 0.01])
def test_orthogonal(kind: type[Any], shape: tuple[int, ...], patch_size: int, gain: float) -> None:
    convolutions = {"image": nn.Conv2d(4, 16, 3), "array": nn.Conv1d(4, 16, 3)}
    network = nn.ModuleDict({"tit": make(kind, shape, patch_size), **convolutions})
    for parameter in network.parameters():
        parameter.data.add_(0.01)  # biases that are 0 already would prove nothing
    before = {name: p.detach().clone() for name, p in network.named_parameters()}
    init_orthogonal_(network, gain)
    changed = set()
    for name, module in network.named_modules():
        if isinstance(module, nn.Linear | nn.Conv2d | ImagePatchEmbedding):
            matrix = module.weight.flatten(1)
            matrix = matrix.T if matrix.shape[0] > matrix.shape[1] else matrix
            expected = gain**2 * torch.eye(len(matrix))
            torch.testing.assert_close(matrix @ matrix.T, expected, rtol=0, atol=1e-4 * gain**2)
            changed.add(f"{name}.weight")
            if (bias := getattr(module, "bias", None)) is not None:
                assert not bias.any()
                changed.add(f"{name}.bias")
    assert any("out_proj" in name for name in changed)
    # Array patches, input projections, LayerNorms, class token and positions stay.
    for name, parameter in network.named_parameters():
        assert torch.equal(parameter, before[name]) == (name not in changed), name
