"""Checks of values before training."""

from __future__ import annotations

import numpy as np
import torch
from gymnasium import Space
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from torch import Tensor

from torchrl_tit.datasets.errors import DatasetError

FLAGS = ("terminals", "timeouts", "terminations", "truncations")  # D4RL's names and Minari's

_LARGEST = np.iinfo(np.int64).max

# Actions of a squashed policy reach the bounds, and rounding moves some slightly beyond them.
_ACTION_TOLERANCE = 1e-5


def check_finite(
    source: str,
    field: str,
    values: NDArray,
    first_row: int = 0,
    kept_as: torch.dtype = torch.float64,
) -> None:
    """Checks that values are finite, also after conversion, or integers that fit.

    Args:
        source: Where the data came from, for error messages.
        field: Name of the field.
        values: Some rows of it.
        first_row: Index of the first of these rows.
        kept_as: The dtype that they are converted to, which may have a smaller range.

    Raises:
        DatasetError: If a value is not finite or too large; the message names the first such row.

    Example:
        >>> check_finite("a.hdf5", "rewards", np.array([0.0, np.nan]), first_row=100)
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.errors.DatasetError: a.hdf5: field 'rewards', row 101: is nan, but...
    """
    if np.issubdtype(values.dtype, np.floating):
        wrong = ~plain_tensor(values).to(kept_as).isfinite().numpy()
    elif values.dtype.itemsize == 8 and values.dtype.kind == "u" and kept_as == torch.int64:
        wrong = values > _LARGEST
    else:
        return
    if wrong.any():
        row = int(wrong.reshape(len(values), -1).any(1).argmax())
        value = values[row][wrong[row]].flat[0] if values.ndim > 1 else values[row]
        kind = str(kept_as).removeprefix("torch.")
        problem = f"at most {_LARGEST}, the largest {kind}"
        if np.issubdtype(values.dtype, np.floating):
            problem = f"finite as {kind}" if np.isfinite(value) else "finite"
        raise DatasetError(
            source, f"is {value}, but all values must be {problem}.", field, first_row + row
        )


def check_actions(source: str, values: NDArray, space: Space, first_row: int = 0) -> None:
    """Checks that actions lie in the action space.

    Args:
        source: Where the data came from, for error messages.
        values: Some rows of the actions.
        space: A `Box` or `Discrete` action space; others are not checked.
        first_row: Index of the first of these rows.

    Raises:
        DatasetError: If an action lies outside; the message names the first such row.

    Example:
        >>> check_actions("a.hdf5", np.array([[1.5]]), Box(-1.0, 1.0, (1,)))
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.errors.DatasetError: a.hdf5: field 'actions', row 0: is 1.5, but...
    """
    if isinstance(space, Box):
        low, high, tolerance = space.low, space.high, _ACTION_TOLERANCE
    elif isinstance(space, Discrete):
        low, high = np.array(space.start), np.array(space.start + space.n - 1)
        tolerance = 0.0
    else:
        return
    wrong = (values < low - tolerance) | (values > high + tolerance)
    if wrong.any():
        row = int(wrong.reshape(len(values), -1).any(1).argmax())
        entries = np.broadcast_arrays(values[row], low, high)
        value, lowest, highest = (x[np.asarray(wrong[row])].flat[0] for x in entries)
        raise DatasetError(
            source,
            f"is {value}, but the task's actions range from {lowest} to {highest} here.",
            "actions",
            first_row + row,
        )


def kept_dtype(source: str, field: str, dtype: np.dtype, floats: torch.dtype | None) -> torch.dtype:
    """Returns the dtype in which a field is stored.

    Args:
        source: Where the data came from, for error messages.
        field: Name of the field.
        dtype: The field's dtype in the source.
        floats: The dtype for floats; None keeps that of the source.

    Returns:
        The dtype: bool for flags, floating for rewards, uint8 or int64 for other integers.

    Raises:
        DatasetError: If the field's values are not numbers.
        ValueError: If ``floats`` is not a floating-point dtype.

    Example:
        >>> kept_dtype("a.hdf5", "rewards", np.dtype("float64"), torch.float32)
        torch.float32
    """
    if not (floats is None or (isinstance(floats, torch.dtype) and floats.is_floating_point)):
        raise ValueError(f"dtype is that of floats, such as torch.float32, not {floats}")
    if dtype.kind not in "biuf":
        raise DatasetError(source, f"has the dtype {dtype}, but must have a numeric one.", field)
    if dtype.kind == "f" and dtype.itemsize > 8:
        raise DatasetError(
            source, f"has the dtype {dtype}, which PyTorch lacks: store it as float64.", field
        )
    if field in FLAGS:
        return torch.bool
    if dtype.kind == "f":
        return floats or plain_tensor(np.empty(0, dtype)).dtype
    if field == "rewards":
        return floats or torch.float32
    return torch.uint8 if dtype == np.uint8 else torch.int64


def plain_tensor(values: NDArray) -> Tensor:
    """Converts an array of any layout into a tensor.

    Args:
        values: The array, in any byte order and memory layout.

    Returns:
        A tensor of the same shape, dtype and values.

    Example:
        >>> plain_tensor(np.array([1.0, 2.0], dtype=">f8"))
        tensor([1., 2.], dtype=torch.float64)
    """
    return torch.from_numpy(np.ascontiguousarray(values, values.dtype.newbyteorder("=")))
