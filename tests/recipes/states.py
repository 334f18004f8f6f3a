"""States of checkpoints, compared, and recipes with which training fails."""

import copy
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase

from recipes.recipe import Recipe

TIMES = ("time", "steps_per_second")
"""Columns of metrics that differ from run to run."""


def unchecked(recipe: Recipe, **fields: Any) -> Any:
    """Returns a recipe with values that it refuses, for what training does about them."""
    copied = copy.copy(recipe)
    for name, value in fields.items():
        object.__setattr__(copied, name, value)
    return copied


def assert_same(left: Any, right: Any) -> None:
    assert type(left) is type(right)
    if isinstance(left, dict | TensorDictBase):
        assert set(left.keys()) == set(right.keys())
        for key in left.keys():  # noqa: SIM118 - of a tensordict, the entries are its rows
            assert_same(left[key], right[key])
    elif isinstance(left, list | tuple):
        for a, b in zip(left, right, strict=True):
            assert_same(a, b)
    elif isinstance(left, torch.Tensor):
        torch.testing.assert_close(left, right, rtol=0, atol=0, equal_nan=True)
    elif isinstance(left, np.ndarray):
        np.testing.assert_array_equal(left, right)
    elif isinstance(left, int | float | str):
        assert left == right or (left != left and right != right)  # NaN
