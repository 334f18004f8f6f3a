"""ResNet and its parts: the rest is proved against the authors' names in tests/interop."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional as F

from tests.numerics import assert_near
from torchrl_tit.layers.torsos import ResidualBlock, ResNetTorso
from torchrl_tit.networks import ResNet

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]


def test_size_for_atari() -> None:
    assert ResNetTorso(4, (84, 84)).out_features == 25_600
    network = ResNet((84, 84), 4)
    assert network.features_dim == 512
    # 4 x 64 x 8 x 8 + 64, twice 64 x 64 x 3 x 3 + 64, 25,600 x 512 + 512
    assert sum(p.numel() for p in network.parameters()) == 16_448 + 2 * 36_928 + 13_107_712


def test_residual_block_is_input_plus_relu_of_convolution() -> None:
    block, x = ResidualBlock(3), torch.randn(2, 3, 5, 4)
    expected = x + F.conv2d(x, block.conv.weight, block.conv.bias, padding=1).clamp(min=0)
    assert_near(block(x), expected)


def test_images_that_are_too_small() -> None:
    with pytest.raises(ValueError, match=r"7 x 84 pixels.*at least 8"):
        ResNet((7, 84), 4)
