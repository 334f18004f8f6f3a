"""Patch embeddings: one observation to a sequence of tokens."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class ArrayPatchEmbedding(nn.Module):
    """Embeds windows of P entries of an array observation, without a bias.

    Where P does not divide the size D, the array is zero-padded at both ends by
    ``ceil((ceil(D / P) * P - D) / 2)``, as in the authors' code, which gives ``ceil(D / P)``
    patches. The same as a 1-d convolution with kernel and stride P.

    Args:
        size: entries D of an observation.
        patch_size: entries P of a patch.
        embed_dim: width of a token.
        channels: arrays that are stacked in one observation (frames, say); 1 for a plain one.

    Example:
        >>> ArrayPatchEmbedding(size=11, patch_size=4, embed_dim=32)(torch.randn(8, 1, 11)).shape
        torch.Size([8, 3, 32])
    """

    def __init__(self, size: int, patch_size: int, embed_dim: int, *, channels: int = 1) -> None:
        super().__init__()
        self.patch_size = patch_size
        self.num_patches = math.ceil(size / patch_size)
        self.padding = math.ceil((self.num_patches * patch_size - size) / 2)
        self.weight = nn.Parameter(torch.empty(embed_dim, channels, patch_size))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initialises as ``nn.Conv1d`` does."""
        nn.init.kaiming_uniform_(self.weight, a=math.sqrt(5))

    def extra_repr(self) -> str:
        """Shows the shape of the weight: width, channels, P."""
        return f"{', '.join(map(str, self.weight.shape))}, padding={self.padding}"

    def forward(self, x: Tensor) -> Tensor:
        """[N, channels, D] of any float type or uint8 -> tokens [N, ceil(D / P), embed_dim]."""
        if self.padding:
            x = F.pad(x, (self.padding, self.padding))
        x = x[..., : self.num_patches * self.patch_size]  # padding both ends may leave a remainder
        x = x.unflatten(-1, (self.num_patches, self.patch_size))  # [N, C, patches, P]
        return embed(x.transpose(1, 2).flatten(2), self.weight)


class ImagePatchEmbedding(nn.Module):
    """Embeds non-overlapping P x P patches of an image, without a bias.

    Rows first: patch ``i * W / P + j`` is the one in row i and column j of the grid. The same as
    a 2-d convolution with kernel and stride P (arXiv 2212.14538, steps 1 and 2 of the inner
    transformer).

    Args:
        channels: channels C of the image.
        size: height and width in pixels; both must be multiples of ``patch_size``.
        patch_size: side P of a patch in pixels.
        embed_dim: width of a token.

    Raises:
        ValueError: if the patch is larger than the image or does not divide it.

    Example:
        >>> embedding = ImagePatchEmbedding(3, (84, 84), patch_size=12, embed_dim=64)
        >>> embedding(torch.zeros(8, 3, 84, 84, dtype=torch.uint8)).shape
        torch.Size([8, 49, 64])
    """

    def __init__(
        self, channels: int, size: tuple[int, int], patch_size: int, embed_dim: int
    ) -> None:
        super().__init__()
        height, width = size
        if patch_size > min(size):
            raise ValueError(
                f"patch_size {patch_size} is larger than the image of {height} x {width} pixels"
            )
        if height % patch_size or width % patch_size:
            common = math.gcd(height, width)
            divisors = [p for p in range(1, common + 1) if common % p == 0]
            raise ValueError(
                f"patch_size {patch_size} does not divide the image of {height} x {width} pixels: "
                f"choose one of {divisors}, or resize the image"
            )
        self.patch_size = patch_size
        self.grid = (height // patch_size, width // patch_size)
        self.num_patches = self.grid[0] * self.grid[1]
        self.weight = nn.Parameter(torch.empty(embed_dim, channels, patch_size, patch_size))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initialises as ``nn.Conv2d`` does."""
        nn.init.kaiming_uniform_(self.weight, a=math.sqrt(5))

    def extra_repr(self) -> str:
        """Shows the shape of the weight: width, C, P, P."""
        return f"{', '.join(map(str, self.weight.shape))}, grid={self.grid}"

    def forward(self, x: Tensor) -> Tensor:
        """[N, C, H, W], float or uint8 -> tokens [N, H / P * W / P, embed_dim]."""
        rows, columns = self.grid
        x = x.unflatten(-1, (columns, self.patch_size)).unflatten(-3, (rows, self.patch_size))
        # [N, C, rows, P, columns, P] -> [N, rows, columns, C, P, P]; bytes are moved, not floats
        return embed(x.permute(0, 2, 4, 1, 3, 5).flatten(3).flatten(1, 2), self.weight)


def embed(patches: Tensor, weight: Tensor) -> Tensor:
    """Maps patches [N, patches, entries] to tokens with a weight [width, ...] over their entries.

    Bytes become 0..1: the division by 255 is done on the weights, which are few.
    """
    weight = weight.flatten(1)
    if patches.dtype == torch.uint8:
        return F.linear(patches.to(weight.dtype), weight / 255)
    return F.linear(patches, weight)


def make_patch_embedding(
    observation_shape: Sequence[int], patch_size: int, embed_dim: int, *, num_frames: int = 1
) -> ArrayPatchEmbedding | ImagePatchEmbedding:
    """Builds the patch embedding that fits an observation.

    Args:
        observation_shape: (D,) for arrays, (H, W) or (C, H, W) for images.
        patch_size: entries, or pixels along a side, of a patch.
        embed_dim: width of a token.
        num_frames: observations stacked as channels.

    Example:
        >>> make_patch_embedding((84, 84), patch_size=12, embed_dim=64, num_frames=4).weight.shape
        torch.Size([64, 4, 12, 12])
    """
    if len(observation_shape) == 1:
        return ArrayPatchEmbedding(observation_shape[0], patch_size, embed_dim, channels=num_frames)
    channels = num_frames * (observation_shape[0] if len(observation_shape) == 3 else 1)
    height, width = observation_shape[-2:]
    return ImagePatchEmbedding(channels, (height, width), patch_size, embed_dim)
