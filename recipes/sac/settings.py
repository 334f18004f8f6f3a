"""Settings of SAC; the algorithm is in algorithm.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from torchrl_tit.settings import Network
from torchrl_tit.settings.numbers import Fraction, Rate, Widths

from ..replay_recipe import ReplayRecipe


@dataclass(frozen=True, kw_only=True)
class SAC(ReplayRecipe, algorithm="sac"):
    """Soft actor-critic (arXiv 1812.05905) with two critics and a learned temperature."""

    learning_rate: Rate = 3e-4
    """Learning rate of Adam for actor, critics and temperature."""
    tau: Fraction = 0.005
    """Coefficient of the soft update of the target critics at each gradient step, from 0 to 1."""
    critic: Literal["auto", "mlp", "backbone"] = "auto"
    """Whether the critics read the newest observation, or each has a backbone with the actor's
    settings, which reads the history. "auto" takes the backbone if velocities are hidden, because
    one observation is then not enough, else the newest observation."""
    critic_hidden: Widths = (256, 256)
    """Widths of the critics' hidden layers."""

    def build(self) -> Any:
        """Builds the algorithm."""
        from .algorithm import SACAlgorithm

        return SACAlgorithm(self)

    @property
    def critic_backbone(self) -> Network | None:
        """The settings of each critic's backbone; None if it reads the newest observation."""
        if self.critic == "backbone" or (self.critic == "auto" and self.hide_velocities):
            return self.backbone
        return None
