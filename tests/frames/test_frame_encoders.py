"""Frame encoders against the layers that they are, and behind a running normalization."""

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
from torchrl_tit.frames.normalized import NormalizedFrames
from torchrl_tit.layers.patches import ArrayPatchEmbedding


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


@pytest.mark.parametrize("of_data", [False, True])
def test_statistics_of_parts_are_those_of_the_whole(of_data: bool) -> None:
    torch.manual_seed(0)
    observations = torch.randn(600, 4) * torch.tensor([1e-2, 1.0, 50.0, 1.0]) + 3
    frames = NormalizedFrames(settings.Linear().build((4,)))
    parts = observations.split([1, 199, 400])
    if of_data:  # learning goes on online
        data = observations[:200]
        frames.set_statistics(data.mean(0), data.std(0, unbiased=False), 200)
        parts = parts[2:]
    for part in parts:
        frames.update(part)
    torch.testing.assert_close(frames.mean, observations.mean(0))
    torch.testing.assert_close(frames.variance, observations.var(0, unbiased=False))


@pytest.mark.parametrize("shape", [(3, 6, 5), (6, 5)])
def test_each_pixel_of_an_image_has_statistics_of_its_own(shape: tuple[int, ...]) -> None:
    torch.manual_seed(0)
    images = torch.randint(100, 256, (700, *shape), dtype=torch.uint8)
    images[:, ..., 2] //= 4
    frames = NormalizedFrames(settings.Flat().build(shape))
    for part in images.split([1, 299, 400]):
        frames.update(part)
    floats = images.double() / 255
    assert frames.mean.shape == shape
    torch.testing.assert_close(frames.mean.double(), floats.mean(0), rtol=1e-5, atol=1e-6)
    expected = (floats - floats.mean(0)) / floats.std(0, unbiased=False)
    for read in (images, images.float() / 255):
        torch.testing.assert_close(frames.normalize(read).double(), expected, rtol=1e-4, atol=1e-4)


def test_entries_that_never_change_and_outliers_stay_finite() -> None:
    frames = NormalizedFrames(settings.Linear().build((2,)), limit=5.0)
    frames.update(torch.tensor([[1.0, 0.0], [1.0, 2.0]]))
    normal = frames.normalize(torch.tensor([[1.0, 1e6], [2.0, 1.0]]))
    assert normal.tolist() == [[0.0, 5.0], [5.0, 0.0]]


def test_it_encodes_normalized_observations() -> None:
    encoder = settings.Inner(embed_dim=8).build((4,))
    frames = NormalizedFrames(encoder)
    observations = 100 * torch.randn(16, 4)
    torch.testing.assert_close(frames(observations), encoder(observations.clamp(-10, 10)))
    frames.update(observations)
    expected = (observations - observations.mean(0)) / observations.std(0, unbiased=False)
    torch.testing.assert_close(frames(observations), encoder(expected), rtol=1e-4, atol=1e-5)
    maps = zip(frames.attention_maps(observations), encoder.attention_maps(expected), strict=True)
    for found, wanted in maps:
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-5)
    assert set(frames.state_dict()) >= {"count", "mean", "variance"}


@pytest.mark.parametrize("patch_size", [1, 3, 11])
def test_each_patch_has_weights_of_its_own(patch_size: int) -> None:
    embedding = ArrayPatchEmbedding(11, patch_size, 8, channels=2, own_weights=True)
    observation = torch.randn(5, 2, 11)
    padded = torch.nn.functional.pad(observation, (embedding.padding, embedding.padding))
    tokens = embedding(observation)
    assert tokens.shape == (5, embedding.num_patches, 8)
    assert embedding.bias is not None
    for index in range(embedding.num_patches):
        patch = padded[..., index * patch_size : (index + 1) * patch_size].flatten(1)
        expected = patch @ embedding.weight[index].flatten(1).t() + embedding.bias[index]
        torch.testing.assert_close(tokens[:, index], expected)
    pixels = torch.randint(256, observation.shape, dtype=torch.uint8)
    torch.testing.assert_close(embedding(pixels), embedding(pixels / 255))
