"""The weights with the highest return so far, which a run keeps in addition to its last ones."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Sequence
from typing import Any

from .algorithm import Stateful

EPISODES = 20
"""Number of training episodes over which returns are averaged."""


class Best:
    """Keeps a copy of the weights with the highest return so far.

    That is the mean return of an evaluation during training. Where there is none, it is that of the
    last 20 training episodes, and the weights are those that collected the last of them. Of runs
    without an environment, it is minus the error on held-out episodes. If returns are equal, the
    later weights are kept. The copy is part of each checkpoint.

    The maximum of many noisy means is biased upwards: only new episodes say what the weights reach.

    Args:
        networks: the networks that are trained.
    """

    def __init__(self, networks: Stateful) -> None:
        self.step: int | None = None
        """Number of steps that the kept weights were trained for; None if there are none yet."""
        self.return_mean = float("-inf")
        """The return that they reached in training."""
        self._networks = networks
        self._weights: dict[str, Any] = {}
        self._returns: deque[float] = deque(maxlen=EPISODES)

    def add_episodes(self, step: int, returns: Sequence[float]) -> None:
        """Adds the returns of training episodes.

        Args:
            step: number of steps that the weights which collected them were trained for.
            returns: returns of the episodes that ended in a batch.
        """
        self._returns += returns
        if returns and len(self._returns) == EPISODES:
            self.offer(step, sum(self._returns) / EPISODES)

    def forget(self) -> None:
        """Drops the weights, before they are compared by another kind of return."""
        self.step, self.return_mean, self._weights = None, float("-inf"), {}

    def offer(self, step: int, return_mean: float) -> None:
        """Keeps the current weights if no earlier ones had a higher return."""
        if return_mean >= self.return_mean:
            self.step, self.return_mean = step, return_mean
            self._weights = copy.deepcopy(self._networks.state_dict())

    def state_dict(self) -> dict[str, Any]:
        """Returns the weights, their return, and the returns of the last episodes."""
        return {
            "step": self.step,
            "return_mean": self.return_mean,
            "networks": self._weights,
            "returns": list(self._returns),
        }

    def load_state_dict(self, state_dict: dict[str, Any], /) -> None:
        """Restores a state."""
        self.step, self.return_mean = state_dict["step"], state_dict["return_mean"]
        self._weights = state_dict["networks"]
        self._returns = deque(state_dict["returns"], maxlen=EPISODES)
