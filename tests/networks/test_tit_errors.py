"""What is wrong is refused early, with what was given, what was expected and what to do."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from torchrl_tit.networks import EnhancedTIT, VanillaTIT

BOTH = pytest.mark.parametrize("kind", [EnhancedTIT, VanillaTIT])


@pytest.mark.parametrize(
    "shape", [(3, 4), (3, 5), (2, 5, 3), (4,), (), (5, 3), (2, 4, 4), (2, 3, 5)]
)
@BOTH
def test_history_of_another_shape(kind: type[Any], shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected \[\.\.\., 4, 3\]") as error:
        kind((3,), 4)(torch.zeros(shape))
    assert str(tuple(shape)) in str(error.value)


@BOTH
@pytest.mark.parametrize("dtype", [torch.float64, torch.int64, torch.bool, torch.bfloat16])
def test_history_of_another_dtype(kind: type[Any], dtype: torch.dtype) -> None:
    tit = kind((3,), 2)
    hint = "give it torch.float32 or" if dtype.is_floating_point else "if it counts categories"
    with pytest.raises(TypeError, match=rf"{dtype} .* network of torch.float32: {hint}"):
        tit(torch.zeros(5, 2, 3, dtype=dtype))
