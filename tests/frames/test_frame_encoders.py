"""Frame encoders against the layers that they are, one observation at a time."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from tests.networks.reference import randomize
from torchrl_tit import settings
from torchrl_tit.frames.cnn import CNNFrameEncoder
from torchrl_tit.frames.flat import Flat
from torchrl_tit.frames.linear import LinearFrameEncoder


@pytest.mark.parametrize(
    ("kind", "shape"),
    [
        (settings.ResNetFrames, (20, 20)),
        (settings.ResNetFrames, (3, 8, 24)),
        (settings.NatureCNNFrames, (3, 36, 52)),
    ],
)
def test_convolutions_read_one_frame_at_a_time(kind: Any, shape: tuple[int, ...]) -> None:
    encoder = CNNFrameEncoder(kind(embed_dim=16), shape)
    layers = nn.Sequential(encoder.torso, encoder.linear)
    frames = torch.rand(2, 3, *shape)
    tokens = encoder(frames)
    assert tokens.shape == (2, 3, encoder.num_tokens, encoder.width) == (2, 3, 1, 16)
    for b in range(2):
        for k in range(3):
            torch.testing.assert_close(encoder(frames[b, k]), tokens[b, k])
            image = frames[b, k].reshape(1, -1, *shape[-2:])
            torch.testing.assert_close(layers(image), tokens[b, k])


def test_flat_frames_are_the_observations() -> None:
    encoder = Flat(settings.Flat(), (3, 4, 5))
    frames = torch.randint(0, 256, (2, 7, 3, 4, 5), dtype=torch.uint8)
    tokens = encoder(frames)
    assert (encoder.num_tokens, encoder.width) == (1, 60)
    assert tokens.dtype == torch.uint8
    assert torch.equal(tokens, frames.reshape(2, 7, 1, 60))


@pytest.mark.parametrize("shape", [(5,), (4, 6), (3, 4, 6)])
@pytest.mark.parametrize("bias", [False, True])
@pytest.mark.parametrize("activation", ["none", "tanh", "relu"])
def test_linear_frames_are_a_linear_layer(
    shape: tuple[int, ...], bias: bool, activation: Any
) -> None:
    choices = settings.Linear(embed_dim=8, bias=bias, activation=activation)
    encoder = LinearFrameEncoder(choices, shape)
    randomize(encoder)
    assert (encoder.linear.bias is not None) == bias
    frames = torch.randint(0, 256, (2, 7, *shape), dtype=torch.uint8)
    expected = encoder.linear(frames.reshape(2, 7, 1, -1) / 255)
    if activation != "none":
        expected = getattr(torch, activation)(expected)
    torch.testing.assert_close(encoder(frames), expected)
    torch.testing.assert_close(encoder(frames / 255), expected)
