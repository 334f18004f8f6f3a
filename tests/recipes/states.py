"""States of checkpoints, compared."""

from typing import Any

import torch

TIMES = ("time", "steps_per_second")
"""Columns of metrics that differ from run to run."""


def assert_same(left: Any, right: Any) -> None:
    assert type(left) is type(right)
    if isinstance(left, dict):
        assert left.keys() == right.keys()
        for key in left:
            assert_same(left[key], right[key])
    elif isinstance(left, list | tuple):
        for a, b in zip(left, right, strict=True):
            assert_same(a, b)
    elif isinstance(left, torch.Tensor):
        assert torch.equal(left, right)
    elif isinstance(left, int | float | str):
        assert left == right or (left != left and right != right)  # NaN
