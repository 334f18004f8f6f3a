"""What is the same but for rounding, on any processor and with any number of threads."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_flatten

# Some hundreds of times what one operation may lose: a network rounds many times in a row.
ROUNDING = {torch.float64: 1e-10, torch.float32: 5e-5}


def assert_near(actual: Any, expected: Any, **options: Any) -> None:
    """Fails if tensors, or lists, tuples and dictionaries of them, differ by more than rounding.

    Processors, and numbers of threads, differ in the order in which they add numbers up. What that
    changes follows the largest terms of a sum, however small the sum is. So all entries of a tensor
    have one tolerance: ``ROUNDING`` times the largest of them, or times 1 if all are smaller.
    Tests that float32 is not the point of are sharper in float64: see the fixture ``float64``.
    ``options`` go to ``torch.testing.assert_close``.
    """
    actual, structure = tree_flatten(actual)
    expected, expected_structure = tree_flatten(expected)
    assert structure == expected_structure
    for value, other in zip(actual, expected, strict=True):
        torch.testing.assert_close(value, other, rtol=0, atol=tolerance(other), **options)


def tolerance(expected: Tensor) -> float:
    sizes = expected.detach().abs()
    largest = sizes[sizes.isfinite()].max().item() if sizes.isfinite().any() else 0.0
    return ROUNDING.get(expected.dtype, 0.0) * max(1.0, largest)
