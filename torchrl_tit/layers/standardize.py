"""Standard scores: the small number that keeps a division finite, and the type of sums."""

from __future__ import annotations

import torch
from torch import Tensor


def standardize(x: Tensor, mean: Tensor | float, std: Tensor, eps: float) -> Tensor:
    """Subtracts a mean and divides by a standard deviation plus ``eps``.

    Every division by a deviation here goes through this function. Where entries never changed, the
    deviation is 0 and ``eps`` alone decides how large a later change becomes; so each caller takes
    the number of its paper or its authors' code.

    Args:
        x: float, any shape.
        mean: broadcastable to it.
        std: the deviation, at least 0; broadcastable to it.
        eps: is added to the deviation.

    Example:
        >>> standardize(torch.tensor([3.0, 0.5]), 0.0, torch.tensor([2.0, 0.0]), eps=1e-3)
        tensor([  1.4993, 500.0000])
    """
    return (x - mean) / (std + eps)


def widest_float(device: torch.device) -> torch.dtype:
    """The widest float type of a device: float64, or float32 on Apple's "mps", which lacks it.

    Example:
        >>> widest_float(torch.device("mps"))
        torch.float32
    """
    return torch.float32 if device.type == "mps" else torch.float64
