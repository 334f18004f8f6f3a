"""Images: uint8 inputs, frames as a batch or as channels, and the convolutions of the baselines."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F


def bytes_to_floats(x: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """Converts bytes (uint8) to floats from 0 to 1, and leaves floats unchanged.

    Example:
        >>> bytes_to_floats(torch.tensor([0, 51, 255], dtype=torch.uint8))
        tensor([0.0000, 0.2000, 1.0000])
    """
    return x.to(dtype) / 255 if x.dtype == torch.uint8 else x


class ImageConv2d(nn.Conv2d):
    """2-d convolution without padding that reads floats, or bytes (uint8), which it divides by 255.

    The division is applied to the weights, which are fewer.

    Example:
        >>> conv = ImageConv2d(4, 32, kernel_size=8, stride=4)
        >>> conv(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 32, 20, 20])
    """

    def forward(self, input: Tensor) -> Tensor:
        """[N, C, H, W], float or uint8 -> float [N, out_channels, H', W']."""
        if input.dtype == torch.uint8:
            weight = self.weight / 255
            return F.conv2d(input.to(weight.dtype), weight, self.bias, self.stride)
        return super().forward(input)


def as_images(x: Tensor, ndim: int) -> tuple[Tensor, tuple[int, ...]]:
    """Reshapes the last ``ndim`` axes into one image; all but the last two become its channels.

    Args:
        x: [..., *channels, H, W].
        ndim: number of axes of ``channels`` plus 2.

    Returns:
        [N, channels, H, W] and the leading shape, whose product is N.

    Example:
        >>> images, leading = as_images(torch.zeros(5, 7, 4, 3, 84, 84), ndim=4)
        >>> images.shape, leading
        (torch.Size([35, 12, 84, 84]), (5, 7))
    """
    leading = tuple(x.shape[: x.ndim - ndim])
    channels = math.prod(x.shape[x.ndim - ndim : -2])
    return x.reshape(math.prod(leading), channels, *x.shape[-2:]), leading


class ResidualBlock(nn.Module):
    """``x + relu(conv3x3(x))``.

    Args:
        channels: channels of input and output.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Float [N, channels, H, W] -> the same."""
        return x + self.conv(x).relu()


_CONVOLUTIONS = {
    "nature-cnn": [(32, 8, 4), (64, 4, 2), (64, 3, 1)],
    "resnet": [(64, 8, 4)],
    "minatar-cnn": [(16, 3, 1)],
}
"""Filters, kernel size and stride of the convolutions that make an image smaller."""


class ConvolutionalTorso(nn.Module):
    """The convolutions of a baseline, and the sizes of images that they read.

    "nature-cnn" has three with relu: 32 filters of 8x8 and stride 4, 64 of 4x4 and stride 2, 64 of
    3x3 (Mnih et al., "Human-level control through deep reinforcement learning", Nature 518, 2015).
    "resnet" has one of 64 filters of 8x8 and stride 4 with relu, and two residual blocks, as the
    authors of arXiv 2212.14538 built it for ResNet and Catformer. "minatar-cnn" has one of 16
    filters of 3x3 with relu (Young and Tian, arXiv 1903.03176).

    Args:
        name: which convolutions.
        observation_shape: (H, W) or (C, H, W), at least 36 pixels per side ("resnet": 8,
            "minatar-cnn": 3).
        num_frames: observations that are stacked as channels.

    Raises:
        ValueError: if observations are not images of that size.

    Example:
        >>> torso = ConvolutionalTorso("nature-cnn", (84, 84), num_frames=4)
        >>> torso(torch.zeros(2, 4, 84, 84)).shape
        torch.Size([2, 3136])
    """

    def __init__(self, name: str, observation_shape: Sequence[int], num_frames: int = 1) -> None:
        super().__init__()
        if len(observation_shape) == 1:
            raise ValueError(
                f"observation_shape {tuple(observation_shape)} is that of an array, but this "
                "encoder reads images (H, W) or (C, H, W): for arrays take inner or linear frames, "
                "or stack them for an mlp"
            )
        smallest, sides = 1, list(observation_shape[-2:])
        for _, kernel, stride in reversed(_CONVOLUTIONS[name]):
            smallest = (smallest - 1) * stride + kernel
        if min(sides) < smallest:
            raise ValueError(
                f"images of {sides[0]} x {sides[1]} pixels are too small for these convolutions: "
                f"both sides must have at least {smallest}"
            )
        channels = num_frames * math.prod(observation_shape[:-2])
        layers: list[nn.Module] = []
        for filters, kernel, stride in _CONVOLUTIONS[name]:
            layer = nn.Conv2d if layers else ImageConv2d
            layers += [layer(channels, filters, kernel, stride=stride), nn.ReLU()]
            sides = [(side - kernel) // stride + 1 for side in sides]
            channels = filters
        if name == "resnet":
            layers += [ResidualBlock(channels), ResidualBlock(channels)]
        self.out_features = channels * math.prod(sides)
        self.layers = nn.Sequential(*layers, nn.Flatten())

    def forward(self, x: Tensor) -> Tensor:
        """[N, channels, H, W], float or uint8 -> float [N, out_features]."""
        # Convolutions on a CPU take a quarter less time if the channels of a pixel lie together.
        return self.layers(x.contiguous(memory_format=torch.channels_last))
