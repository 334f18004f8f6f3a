"""Settings of implicit Q-learning; the algorithm is in algorithm.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchrl_tit.settings.numbers import Inside, Rate, Weight

from ..transition_recipe import ActorCriticRecipe


@dataclass(frozen=True, kw_only=True)
class IQL(ActorCriticRecipe, algorithm="iql"):
    """Implicit Q-learning (arXiv 2110.06169), with continuous or discrete actions.

    The defaults are those of the paper for MuJoCo.
    """

    learning_rate: Rate = 3e-4
    """Learning rate of Adam for all networks."""
    decay_learning_rate: bool = True
    """Whether the actor's learning rate decays to 0 on a cosine schedule."""
    expectile: Inside = 0.7
    """Expectile of Q(s, a) over the data's actions that V(s) estimates; 0.5 is the mean."""
    temperature: Weight = 3.0
    """Inverse temperature of the weights exp(temperature * advantage) of the actor's loss."""
    normalize_rewards: bool = False
    """Whether rewards are divided by the range of the episodes' returns and multiplied by 1000, as
    in the paper for MuJoCo."""

    def build(self) -> Any:
        """Builds the algorithm."""
        from .algorithm import IQLAlgorithm

        return IQLAlgorithm(self)

    @property
    def schedules(self) -> tuple[str, ...]:
        """The actor's learning rate, if it decays to 0."""
        return ("decay_learning_rate",) if self.decay_learning_rate else ()
