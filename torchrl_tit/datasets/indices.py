"""Finds the items of a storage that an index selects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor


def find_items(index: Any, shape: Sequence[int], device: torch.device) -> Tensor:
    """Finds the items that an index selects, as PyTorch selects entries of a tensor.

    Args:
        index: an integer, a slice, a range, a list, an array or a tensor of integers (negative ones
            count from the end) or of booleans (a mask), or a tuple of these, one per dimension.
        shape: shape of the storage.
        device: device of the items.

    Returns:
        The items' numbers, counted along the last dimension first; int64, with the shape of the
        selection.

    Raises:
        IndexError: If there is no such item (checked only on a CPU), or a mask has another shape.

    Example:
        >>> find_items([0, -1], (5,), torch.device("cpu"))
        tensor([0, 4])
        >>> find_items((torch.tensor([1, 0]), torch.tensor([0, 2])), (2, 3), torch.device("cpu"))
        tensor([3, 2])
    """
    parts = [_as_tensor(part) for part in (index if isinstance(index, tuple) else (index,))]
    if len(parts) != len(shape) or not all(_is_integer(part) for part in parts):
        # Rare: anything but the integers that samplers draw.
        items = torch.arange(math.prod(shape), device=device).view(*shape)
        return items[tuple(x.to(device) if isinstance(x, Tensor) else x for x in parts)]
    items, *others = (_from_zero(x, n, device) for x, n in zip(parts, shape, strict=True))
    for other, size in zip(others, shape[1:], strict=True):
        items = items * size + other
    return items


def _as_tensor(index: Any) -> Any:
    """Converts numbers to a tensor; leaves slices as they are."""
    if isinstance(index, bool) or not isinstance(
        index, list | range | np.ndarray | np.integer | int
    ):
        return index
    values = torch.as_tensor(index)
    return values if values.numel() else values.long()


def _is_integer(index: Any) -> bool:
    """Whether an index is a tensor of integers, and not a mask."""
    dtypes = (torch.int64, torch.int32, torch.int16, torch.int8)
    return isinstance(index, Tensor) and index.dtype in dtypes


def _from_zero(index: Tensor, size: int, device: torch.device) -> Tensor:
    """Counts negative integers from the end."""
    index = index.to(device, torch.int64)
    if index.device.type != "cpu":  # reading the values would synchronize
        return torch.where(index < 0, index + size, index)
    if not index.numel():
        return index
    low, high = map(int, index.aminmax())
    if low < -size or high >= size:
        wrong = high if high >= size else low
        raise IndexError(f"there are {size} items, and none at {wrong}: give -{size} to {size - 1}")
    return torch.where(index < 0, index + size, index) if low < 0 else index
