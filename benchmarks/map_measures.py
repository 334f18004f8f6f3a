"""Measures of maps: how much of them lies on objects, and how much they change."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F

from torchrl_tit.settings.checks import checked_arguments

Background = Literal["place", "color"]
_SYMBOLS = 25


@checked_arguments
def find_objects(
    frames: Tensor, *, background: Background = "place", tolerance: float = 0.04
) -> Tensor:
    """Finds the objects in frames: pixels that differ from the background.

    Args:
        frames: images in order, uint8 or float 0..1, [T, H, W] or [T, C, H, W]. If all bytes are
            less than 25, they are treated as symbols, whose differences exceed the default
            tolerance.
        background: the background: the median over the frames at each place, for static cameras
            ("place"); or the most common color of each frame ("color").
        tolerance: largest difference from the background, in a range from 0 to 1.

    Returns:
        bool [T, H, W].

    Raises:
        ValueError: if frames have another shape, or there is no such background.

    Example:
        >>> frames = torch.zeros(3, 4, 4)
        >>> frames[1, 2, 3] = 1  # a ball
        >>> find_objects(frames).nonzero()
        tensor([[1, 2, 3]])
    """
    if frames.ndim not in (3, 4):
        raise ValueError(f"frames have the shape {list(frames.shape)}, not [T, H, W] or with C")
    images = frames if frames.ndim == 4 else frames.unsqueeze(1)
    if images.dtype == torch.uint8:
        # Small values are symbols, such as MiniGrid's, which differ by one, not by brightness.
        most = int(images.max())
        images = images.float() / (255 if most >= _SYMBOLS else max(most, 1))
    if background == "place":
        usual = images.median(0, keepdim=True).values
    else:
        usual = torch.stack([_most_common(image) for image in images])[..., None, None]
    return ((images - usual).abs() > tolerance).any(1)


def share_on_objects(maps: Tensor, objects: Tensor) -> tuple[Tensor, Tensor]:
    """Measures the share of maps that lies on objects, and the share for uniform maps.

    A map has no detail within a cell, so each cell is weighted by the share of its area that
    objects cover.

    Args:
        maps: not negative, [T, h, w].
        objects: bool [T, H, W].

    Returns:
        The shares of the maps and those of the area, float [T] each; NaN for a map of zeros.

    Raises:
        ValueError: if the numbers of maps and frames differ.

    Example:
        >>> objects = torch.zeros(1, 8, 8, dtype=torch.bool)
        >>> objects[0, :4, :4] = True
        >>> share_on_objects(torch.tensor([[[3.0, 1.0], [0.0, 0.0]]]), objects)
        (tensor([0.7500]), tensor([0.2500]))
    """
    if maps.ndim != 3 or objects.ndim != 3 or len(maps) != len(objects):
        raise ValueError(
            f"maps {list(maps.shape)} and objects {list(objects.shape)} are not [T, h, w] and "
            "[T, H, W] of the same frames"
        )
    height, width = maps.shape[1:]
    covered = F.adaptive_avg_pool2d(objects.to(maps.dtype), (height, width))
    on_objects = (maps * covered).sum((1, 2)) / maps.sum((1, 2))
    return on_objects, objects.to(maps.dtype).mean((1, 2))


def map_change(maps: Tensor, grid: tuple[int, int] = (7, 7)) -> Tensor:
    """Measures how much maps change from each frame to the next.

    Maps are averaged to one grid, so that maps of networks with finer grids can be compared, and
    scaled to a sum of 1. The change is the share of a map that is somewhere else in the next one
    (half of the sum of absolute differences): 0 for the same map, 1 if they do not overlap.

    Args:
        maps: in order, not negative, [T, h, w].
        grid: rows and columns to average to, at most h and w.

    Returns:
        float [T - 1]; NaN next to a map of zeros.

    Raises:
        ValueError: if there are fewer than two maps.

    Example:
        >>> maps = torch.eye(4).reshape(4, 2, 2)
        >>> map_change(maps[[0, 0, 1]], grid=(2, 2))
        tensor([0., 1.])
    """
    if maps.ndim != 3 or len(maps) < 2:
        raise ValueError(f"change needs at least two maps [T, h, w], not {list(maps.shape)}")
    size = (min(grid[0], maps.shape[1]), min(grid[1], maps.shape[2]))
    coarse = F.adaptive_avg_pool2d(maps, size).flatten(1)
    coarse = coarse / coarse.sum(1, keepdim=True)
    return coarse.diff(dim=0).abs().sum(1) / 2


def _most_common(image: Tensor) -> Tensor:
    """The most common color of an image, [C, H, W] -> [C]."""
    colors, counts = image.flatten(1).unique(dim=1, return_counts=True)
    return colors[:, counts.argmax()]
