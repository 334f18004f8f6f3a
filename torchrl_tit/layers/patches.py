"""Patch embeddings, which map one observation to a sequence of tokens."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_tit.layers.categories import CategoryPatchEmbedding

_MOST_CATEGORY_PATCHES = 16
_IMAGE_PATCHES = 49  # as in the paper's Atari games: 84 pixels in patches of 12
_MOST_IMAGE_PATCHES = 1024


class ArrayPatchEmbedding(nn.Module):
    """Embeds windows of P entries of an array observation, without a bias.

    If P does not divide the size D, the array is zero-padded at both ends by
    ``ceil((ceil(D / P) * P - D) / 2)``, as in the authors' code, which gives ``ceil(D / P)``
    patches. The same as a 1-d convolution with kernel and stride P.

    Args:
        size: entries D of an observation.
        patch_size: entries P of a patch.
        embed_dim: width of a token.
        channels: arrays that are stacked in one observation (for example, frames); 1 for a plain
            one.
        own_weights: whether each patch has its own weights and bias.

    Raises:
        ValueError: if the patch is larger than the array.

    Example:
        >>> ArrayPatchEmbedding(size=11, patch_size=4, embed_dim=32)(torch.randn(8, 1, 11)).shape
        torch.Size([8, 3, 32])
    """

    def __init__(
        self,
        size: int,
        patch_size: int,
        embed_dim: int,
        *,
        channels: int = 1,
        own_weights: bool = False,
    ) -> None:
        super().__init__()
        if patch_size > size:
            raise ValueError(
                f"patch_size {patch_size} is larger than the array of {size} entries: choose at "
                f"most {size}, or None for one patch"
            )
        self.patch_size = patch_size
        self.num_patches = math.ceil(size / patch_size)
        self.padding = math.ceil((self.num_patches * patch_size - size) / 2)
        own = (self.num_patches,) if own_weights else ()
        self.weight = nn.Parameter(torch.empty(*own, embed_dim, channels, patch_size))
        self.bias = nn.Parameter(torch.empty(*own, embed_dim)) if own_weights else None
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initializes like ``nn.Conv1d``, and a bias like the token of an entry of size 1."""
        bound = 1 / math.sqrt(self.weight.shape[-2:].numel())
        nn.init.uniform_(self.weight, -bound, bound)
        if self.bias is not None:
            nn.init.uniform_(self.bias, -1, 1)

    def extra_repr(self) -> str:
        """Shows the shape of the weight: width, channels, P."""
        return f"{', '.join(map(str, self.weight.shape))}, padding={self.padding}"

    def forward(self, x: Tensor) -> Tensor:
        """[N, channels, D] of any float type or uint8 -> tokens [N, ceil(D / P), embed_dim]."""
        if self.padding:
            x = F.pad(x, (self.padding, self.padding))
        x = x[..., : self.num_patches * self.patch_size]  # padding both ends may leave a remainder
        x = x.unflatten(-1, (self.num_patches, self.patch_size))  # [N, C, patches, P]
        patches = x.transpose(1, 2).flatten(2)  # [N, patches, C * P]
        tokens = embed(patches, self.weight.flatten(-2))
        return tokens if self.bias is None else tokens + self.bias


class ImagePatchEmbedding(nn.Module):
    """Embeds non-overlapping P x P patches of an image, without a bias.

    Row by row: patch ``i * W / P + j`` is in row i and column j of the grid. The same as a 2-d
    convolution with kernel and stride P (arXiv 2212.14538, steps 1 and 2 of the inner transformer).

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
            divisors = _common_divisors(height, width)
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
        """Initializes like ``nn.Conv2d``."""
        nn.init.kaiming_uniform_(self.weight, a=math.sqrt(5))

    def extra_repr(self) -> str:
        """Shows the shape of the weight: width, C, P, P."""
        return f"{', '.join(map(str, self.weight.shape))}, grid={self.grid}"

    def forward(self, x: Tensor) -> Tensor:
        """[N, C, H, W], float or uint8 -> tokens [N, H / P * W / P, embed_dim]."""
        rows, columns = self.grid
        x = x.unflatten(-1, (columns, self.patch_size)).unflatten(-3, (rows, self.patch_size))
        # [N, C, rows, P, columns, P] -> [N, rows, columns, C, P, P]; moves bytes instead of floats
        return embed(x.permute(0, 2, 4, 1, 3, 5).flatten(3).flatten(1, 2), self.weight.flatten(1))


def embed(patches: Tensor, weight: Tensor) -> Tensor:
    """Maps patches [N, patches, entries] to tokens [N, patches, width].

    The weight is [width, entries], or [patches, width, entries]. Bytes are scaled to 0..1: the
    division by 255 is applied to the weights, which are fewer.
    """
    if patches.dtype == torch.uint8:
        patches, weight = patches.to(weight.dtype), weight / 255
    if weight.ndim == 2:
        return F.linear(patches, weight)
    return torch.einsum("npe,pde->npd", patches, weight)


def find_patch_size(
    observation_shape: Sequence[int],
    patch_size: int | Literal["auto"] | None,
    *,
    categories: bool = False,
) -> int:
    """Finds the patch size that settings leave open.

    Args:
        observation_shape: (D,) for arrays and categories, (H, W) or (C, H, W) for images.
        patch_size: a number, which is returned; None for the whole observation; or "auto". For
            arrays, that is the whole observation. For categories, it is 1 for up to 16 entries,
            else the smallest divisor of the number of entries that gives at most 16 patches. For
            images, it is the side of the square patch that divides them into the number of patches
            nearest to 49, as in the paper's Atari games.
        categories: whether the entries count categories.

    Raises:
        ValueError: if no patch divides an image into fewer than 1025 patches, or None is given for
            an image that is not square.

    Example:
        >>> [find_patch_size(shape, "auto") for shape in [(4,), (27,), (3, 84, 84), (7, 7)]]
        [4, 27, 12, 1]
        >>> find_patch_size((27,), "auto", categories=True)
        3
        >>> find_patch_size((84, 42), None)
        Traceback (most recent call last):
            ...
        ValueError: patch_size is None, but an image of shape (84, 42) is not one square patch: ...
    """
    if patch_size is None:
        if len(observation_shape) > 1 and observation_shape[-1] != observation_shape[-2]:
            raise ValueError(
                f"patch_size is None, but an image of shape {tuple(observation_shape)} is not one "
                'square patch: give its side, or "auto"'
            )
        return observation_shape[-1]
    if patch_size != "auto":
        return patch_size
    if len(observation_shape) == 1:
        (size,) = observation_shape
        if not categories:
            return size
        smallest = math.ceil(size / _MOST_CATEGORY_PATCHES)
        return next(p for p in range(smallest, size + 1) if size % p == 0)
    height, width = observation_shape[-2:]
    counts = {p: height * width // p**2 for p in _common_divisors(height, width)}
    best = min(counts, key=lambda p: abs(counts[p] - _IMAGE_PATCHES))
    if counts[best] > _MOST_IMAGE_PATCHES:
        raise ValueError(
            f"patch_size 'auto' finds no patch for images of {height} x {width} pixels, whose "
            f"sides have the common divisors {list(counts)}: resize them (TorchRL's Resize), or "
            "take nature-cnn frames"
        )
    return best


def _common_divisors(height: int, width: int) -> list[int]:
    common = math.gcd(height, width)
    return [p for p in range(1, common + 1) if common % p == 0]


def make_patch_embedding(
    observation_shape: Sequence[int],
    patch_size: int,
    embed_dim: int,
    *,
    num_frames: int = 1,
    categories: Sequence[int] | None = None,
    own_weights: bool = False,
) -> ArrayPatchEmbedding | ImagePatchEmbedding | CategoryPatchEmbedding:
    """Builds the patch embedding of an observation.

    Args:
        observation_shape: (D,) for arrays and categories, (H, W) or (C, H, W) for images.
        patch_size: entries of a patch, or pixels along its side.
        embed_dim: width of a token.
        num_frames: observations stacked as channels; 1 for categories.
        categories: for categories, the number of values of each entry.
        own_weights: whether each patch of an array has its own weights.

    Example:
        >>> make_patch_embedding((84, 84), patch_size=12, embed_dim=64, num_frames=4).weight.shape
        torch.Size([64, 4, 12, 12])
    """
    if categories is not None:
        return CategoryPatchEmbedding(categories, patch_size, embed_dim)
    if len(observation_shape) == 1:
        return ArrayPatchEmbedding(
            observation_shape[0],
            patch_size,
            embed_dim,
            channels=num_frames,
            own_weights=own_weights,
        )
    channels = num_frames * (observation_shape[0] if len(observation_shape) == 3 else 1)
    height, width = observation_shape[-2:]
    return ImagePatchEmbedding(channels, (height, width), patch_size, embed_dim)
