"""NatureCNN against the same layers in a row."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_tit.networks import NatureCNN

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]


def reference(channels: int, positions: int, features: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels, 32, kernel_size=8, stride=4, padding=0),
        nn.ReLU(),
        nn.Conv2d(32, 64, kernel_size=4, stride=2, padding=0),
        nn.ReLU(),
        nn.Conv2d(64, 64, kernel_size=3, stride=1, padding=0),
        nn.ReLU(),
        nn.Flatten(),
        nn.Linear(64 * positions, features),
        nn.ReLU(),
    )


@pytest.mark.parametrize(
    ("shape", "num_frames", "channels", "positions", "features"),
    [
        ((84, 84), 4, 4, 49, 512),
        ((3, 84, 84), 1, 3, 49, 16),
        ((3, 36, 52), 2, 6, 3, 16),
        ((36, 36), 1, 1, 1, 8),
    ],
)
def test_equals_the_layers_in_a_row(
    shape: tuple[int, ...], num_frames: int, channels: int, positions: int, features: int
) -> None:
    torch.manual_seed(0)
    network = NatureCNN(shape, num_frames, features_dim=features)
    layers = reference(channels, positions, features)
    for ours, theirs in zip(network.parameters(), layers.parameters(), strict=True):
        theirs.data.copy_(ours)
    frames = torch.rand(5, num_frames, *shape, requires_grad=True)
    features_of = network(frames)
    # Oldest frame first, the channels of one frame beside each other.
    stacked = torch.cat(
        [frames[:, k].reshape(5, -1, *shape[-2:]) for k in range(num_frames)], dim=1
    )
    torch.testing.assert_close(features_of, layers(stacked))
    assert features_of.shape == (5, features) == (5, network.features_dim)
    assert (features_of > 0).any()
    features_of.sum().backward()
    assert frames.grad is not None
    assert frames.grad.flatten(2).abs().sum(2).all()


@pytest.mark.parametrize("size", [(84, 35), (35, 84)])
def test_images_that_are_too_small(size: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=rf"{size[0]} x {size[1]} pixels.*at least 36"):
        NatureCNN(size, 4)
