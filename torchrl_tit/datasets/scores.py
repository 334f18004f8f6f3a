"""Returns on the scale from a random to an expert policy, as offline RL reports them."""

from __future__ import annotations

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
    """Puts returns on D4RL's scale: 0 is a random policy's, 100 an expert's.

    Args:
        returns: One return or many.
        name: Name of a data set or task, which begins with one of ``REFERENCE_RETURNS``, such as
            "hopper-medium-v0" or "Hopper-v5".

    Returns:
        100 * (return - random) / (expert - random), of the same kind and shape.

    Raises:
        ValueError: If there are no reference values for that name.

    Source: D4RL (arXiv 2004.07219), section 5.

    Example:
        >>> normalized_score(3234.3, "hopper-medium-v0")
        100.0
    """
    random, expert = _reference(name)
    return 100 * (returns - random) / (expert - random)


def normalized_spread(spread: Returns, name: str) -> Returns:
    """Puts a standard deviation of returns, or another difference of them, on D4RL's scale.

    Args:
        spread: The difference of returns.
        name: As for :func:`normalized_score`.

    Returns:
        100 * spread / (expert - random): a difference has no offset.

    Raises:
        ValueError: If there are no reference values for that name.

    Example:
        >>> round(normalized_spread(325.4572305, "Hopper-v5"), 6)
        10.0
    """
    random, expert = _reference(name)
    return 100 * spread / (expert - random)


def has_reference(name: str) -> bool:
    """Says whether returns of a data set or task can be normalised.

    Args:
        name: As for :func:`normalized_score`.

    Returns:
        Whether there are reference values.

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
    """The task that a name begins with: "hopper" of "mujoco/hopper/medium-v0" and "Hopper-v5"."""
    parts = name.lower().removeprefix("mujoco/").replace("/", "-").split("-")
    return parts[0]
