"""NatureCNN and MinAtar's against the same layers in a row; ResNet is in tests/interop."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import nn

from tests.numerics import assert_near
from torchrl_tit.networks import NatureCNN, build_network
from torchrl_tit.settings import StackedCNN
from torchrl_tit.settings.networks import nature_cnn as settings_of_nature_cnn

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]


def nature_cnn(channels: int, positions: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, 32, kernel_size=8, stride=4),
        nn.ReLU(),
        nn.Conv2d(32, 64, kernel_size=4, stride=2),
        nn.ReLU(),
        nn.Conv2d(64, 64, kernel_size=3),
        nn.ReLU(),
        nn.Flatten(),
        nn.Linear(64 * positions, 16),
        nn.ReLU(),
    )


def minatar_cnn(channels: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, 16, kernel_size=3),
        nn.ReLU(),
        nn.Flatten(),
        nn.Linear(16 * 8 * 8, 16),
        nn.ReLU(),
    )


@pytest.mark.parametrize(
    ("shape", "num_frames", "channels", "positions"),
    [((84, 84), 4, 4, 49), ((3, 36, 52), 2, 6, 3), ((36, 36), 1, 1, 1)],
)
def test_equals_the_layers_in_a_row(shape, num_frames, channels, positions):
    network, layers = NatureCNN(shape, num_frames, features_dim=16), nature_cnn(channels, positions)
    check(network, layers, shape, num_frames)


def test_equals_the_layers_of_minatar_in_a_row():
    settings = replace(
        settings_of_nature_cnn(2, features_dim=16), history=StackedCNN(torso="minatar-cnn")
    )
    check(build_network(settings, (4, 10, 10)), minatar_cnn(8), (4, 10, 10), 2)


def check(network: nn.Module, layers: nn.Module, shape: tuple[int, ...], num_frames: int) -> None:
    for ours, theirs in zip(network.parameters(), layers.parameters(), strict=True):
        theirs.data.copy_(ours)
    frames = torch.rand(5, num_frames, *shape, requires_grad=True)
    features = network(frames)
    # Oldest frame first, the channels of one frame beside each other.
    stacked = torch.cat(
        [frames[:, k].reshape(5, -1, *shape[-2:]) for k in range(num_frames)], dim=1
    )
    assert_near(features, layers(stacked))
    assert (features > 0).any()
    features.sum().backward()
    assert frames.grad is not None
    assert frames.grad.flatten(2).abs().sum(2).all()
