"""Settings of behaviour cloning; the algorithm is in algorithm.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from torchrl_tit.settings.numbers import Rate, Steps

from ..transition_recipe import TransitionRecipe


@dataclass(frozen=True, kw_only=True)
class BC(TransitionRecipe, algorithm="bc"):
    """Behaviour cloning: maximises the likelihood of a data set's actions, of any kind."""

    learning_rate: Rate = 3e-4
    """Learning rate of Adam."""
    time_limits: Literal["keep", "drop"] = "keep"
    """Whether to keep the last transition of an episode that a time limit truncated."""
    unfinished: Literal["keep", "drop"] = "keep"
    """Whether to keep the last episode if the data stop before it ends."""
    evaluation_interval: Steps = 5000
    """Gradient steps between evaluations."""

    def build(self) -> Any:
        """Builds the algorithm."""
        from .algorithm import BCAlgorithm

        return BCAlgorithm(self)
