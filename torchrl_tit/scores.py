"""Normalized scores of returns, as reported in offline RL."""

from __future__ import annotations

import re
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

Returns = TypeVar("Returns", float, Tensor, NDArray[np.floating])

# Mean returns of a random and of an expert policy.
# Source: D4RL (arXiv 2004.07219), the values in its released code.
REFERENCE_RETURNS = {
    "halfcheetah": (-280.178953, 12135.0),
    "hopper": (-20.272305, 3234.3),
    "walker2d": (1.629008, 4592.3),
}


def normalized_score(returns: Returns, name: str) -> Returns:
    """Normalizes returns to D4RL's scale: a random policy scores 0, an expert 100.

    Args:
        returns: one return or many.
        name: name of a data set or task that begins with a key of ``REFERENCE_RETURNS``, such as
            "hopper-medium-v0" or "Hopper-v5".

    Returns:
        100 * (return - random) / (expert - random), of the same kind and shape.

    Raises:
        ValueError: if there are no reference returns for the name.

    Source: D4RL (arXiv 2004.07219), section 5.

    Example:
        >>> normalized_score(3234.3, "hopper-medium-v0")
        100.0
    """
    random, expert = _reference(name)
    return 100 * (returns - random) / (expert - random)


def normalized_spread(spread: Returns, name: str) -> Returns:
    """Normalizes a standard deviation of returns, or another difference, to D4RL's scale.

    Args:
        spread: the difference of returns.
        name: see :func:`normalized_score`.

    Returns:
        100 * spread / (expert - random), without the offset of returns.

    Raises:
        ValueError: if there are no reference returns for the name.

    Example:
        >>> round(normalized_spread(325.4572305, "Hopper-v5"), 6)
        10.0
    """
    random, expert = _reference(name)
    return 100 * spread / (expert - random)


def has_reference(name: str) -> bool:
    """Returns whether there are reference returns for a data set or task.

    Args:
        name: see :func:`normalized_score`.

    Example:
        >>> has_reference("CartPole-v1")
        False
    """
    return _family(name) in REFERENCE_RETURNS


def _reference(name: str) -> tuple[float, float]:
    if not has_reference(name):
        known = ", ".join(map(repr, REFERENCE_RETURNS))
        raise ValueError(
            f"There are no reference returns for {name!r}; a name must begin with one of {known}."
        )
    return REFERENCE_RETURNS[_family(name)]


def _family(name: str) -> str:
    """The task in a name: "hopper" in "mujoco/hopper/medium-v0", "hopper_medium-v2.hdf5"."""
    return re.split("[-_/]", name.lower().removeprefix("mujoco/"), maxsplit=1)[0]
