"""Settings of SAC; the algorithm is in algorithm.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torchrl_tit.settings.numbers import Fraction, Rate, Widths

from ..replay_recipe import ReplayRecipe


@dataclass(frozen=True, kw_only=True)
class SAC(ReplayRecipe, algorithm="sac", builds=f"{__package__}.algorithm:SACAlgorithm"):
    """Soft actor-critic (arXiv 1812.05905) with two critics and a learned temperature."""

    learning_rate: Rate = 3e-4
    """Learning rate of Adam for actor, critics and temperature."""
    tau: Fraction = 0.005
    """Coefficient of the soft update of the target critics at each gradient step, from 0 to 1."""
    critic: Literal["mlp", "backbone"] = "mlp"
    """Whether the critics read the newest observation, or each has a backbone with the actor's
    settings."""
    critic_hidden: Widths = (256, 256)
    """Widths of the critics' hidden layers."""
