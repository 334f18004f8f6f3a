"""A learning rate that follows the KL divergence."""

from __future__ import annotations

from typing import Any


class KLAdaptiveRate:
    """A factor on the learning rate that keeps the KL divergence of an update near a target.

    The rule of skrl's `KLAdaptiveLR` and of rl_games: after each epoch, divide the rate by 1.5 if
    the policy has moved twice as far as the target, multiply it by 1.5 if it has moved less than
    half as far.

    Args:
        target: the KL divergence to keep.
        smallest: the smallest factor.
        largest: the largest factor.

    Example:
        >>> rate = KLAdaptiveRate(0.01)
        >>> rate.update(0.05)
        >>> round(rate.factor, 3)
        0.667
    """

    def __init__(self, target: float, smallest: float = 0.01, largest: float = 10.0) -> None:
        self.target = target
        self.smallest = smallest
        self.largest = largest
        self.factor = 1.0

    def update(self, kl: float) -> None:
        """Adapts the factor to the divergence measured in an epoch."""
        if kl > 2 * self.target:
            self.factor /= 1.5
        elif kl < self.target / 2:
            self.factor *= 1.5
        self.factor = min(max(self.factor, self.smallest), self.largest)

    def state_dict(self) -> dict[str, Any]:
        """Returns the factor."""
        return {"factor": self.factor}

    def load_state_dict(self, state_dict: dict[str, Any], /) -> None:
        """Restores a state."""
        self.factor = state_dict["factor"]
