"""States of checkpoints, compared, and recipes with which training fails."""

import copy
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from recipes.core.recipe import Recipe

TIMES = ("time", "steps_per_second")
"""Columns of metrics that differ from run to run."""


def unchecked(recipe: Recipe, **fields: Any) -> Any:
    """Returns a recipe with values that it refuses, for what training does about them."""
    copied = copy.copy(recipe)
    for name, value in fields.items():
        object.__setattr__(copied, name, value)
    return copied


def assert_same(left: Any, right: Any) -> None:
    """Equal to the last bit, and of the same types all the way down."""
    assert type(left) is type(right)
    if isinstance(left, TensorDictBase):
        assert (left.batch_size, left.device) == (right.batch_size, right.device)
        assert left.names == right.names
        assert_same(dict(sorted(left.items())), dict(sorted(right.items())))
    elif isinstance(left, dict):
        assert [(key, type(key)) for key in left] == [(key, type(key)) for key in right]
        assert_same([*left.values()], [*right.values()])
    elif isinstance(left, list | tuple):
        for a, b in zip(left, right, strict=True):
            assert_same(a, b)
    elif isinstance(left, torch.Tensor):
        assert (left.dtype, left.shape) == (right.dtype, right.shape)
        assert bytes_of(left).equal(bytes_of(right))
    elif isinstance(left, np.ndarray | np.generic):
        assert (left.dtype, left.shape) == (right.dtype, right.shape)
        assert left.tobytes() == right.tobytes()
    elif isinstance(left, float):
        assert left.hex() == right.hex()
    else:
        assert left == right


def bytes_of(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8)
