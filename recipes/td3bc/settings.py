"""Settings of TD3+BC; the algorithm is in algorithm.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchrl_tit.settings.numbers import Rate, Steps, Weight

from ..transition_recipe import ActorCriticRecipe


@dataclass(frozen=True, kw_only=True)
class TD3BC(ActorCriticRecipe, algorithm="td3bc"):
    """TD3 with a behaviour cloning term (arXiv 2106.06860), with the paper's defaults."""

    normalize_observations: bool = True
    """Whether to normalise observations by their mean and standard deviation in the data; only for
    arrays of floats."""
    actor_learning_rate: Rate = 3e-4
    """Learning rate of Adam for the actor."""
    critic_learning_rate: Rate = 3e-4
    """Learning rate of Adam for the critics."""
    alpha: Weight = 2.5
    """Weight of the value in the actor's loss, relative to the behaviour cloning term."""
    policy_delay: Steps = 2
    """Gradient steps of the critics for each update of the actor and the targets."""
    policy_noise: Weight = 0.2
    """Standard deviation of the noise on the target's actions; 1 is half the range of actions."""
    noise_clip: Weight = 0.5
    """Largest absolute value of that noise; 1 is half the range of actions."""

    def build(self) -> Any:
        """Builds the algorithm."""
        from .algorithm import TD3BCAlgorithm

        return TD3BCAlgorithm(self)
