"""Helpers of the convolutional networks: uint8 inputs, and frames as a batch or as channels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn


def bytes_to_floats(x: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """Converts bytes (uint8) to floats from 0 to 1, and leaves floats unchanged.

    Example:
        >>> bytes_to_floats(torch.tensor([0, 51, 255], dtype=torch.uint8))
        tensor([0.0000, 0.2000, 1.0000])
    """
    return x.to(dtype) / 255 if x.dtype == torch.uint8 else x


class ImageConv2d(nn.Conv2d):
    """2-d convolution that reads floats unchanged and divides bytes (uint8) by 255.

    The division is applied to the weights, which are fewer.

    Example:
        >>> conv = ImageConv2d(4, 32, kernel_size=8, stride=4)
        >>> conv(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 32, 20, 20])
    """

    def forward(self, input: Tensor) -> Tensor:
        """[N, C, H, W], float or uint8 -> float [N, out_channels, H', W']."""
        if input.dtype == torch.uint8:
            return self._conv_forward(input.to(self.weight.dtype), self.weight / 255, self.bias)
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


def stacked_shape(
    observation_shape: Sequence[int], num_frames: int = 1
) -> tuple[int, tuple[int, int]]:
    """Returns channels and (height, width) of images that are stacked as channels.

    Example:
        >>> stacked_shape((3, 84, 84), num_frames=4)
        (12, (84, 84))
    """
    height, width = observation_shape[-2:]
    return num_frames * math.prod(observation_shape[:-2]), (height, width)


def convolved_size(size: int, kernels: Sequence[tuple[int, int]]) -> int:
    """Returns the side length that ``size`` pixels have after (kernel, stride) convolutions.

    Example:
        >>> convolved_size(84, [(8, 4), (4, 2), (3, 1)])
        7
    """
    for kernel, stride in kernels:
        size = (size - kernel) // stride + 1
    return size
