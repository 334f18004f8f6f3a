"""Settings of SAC; the algorithm is in algorithm.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torchrl_tit.settings.checks import check_at_least, check_at_most, check_widths

from ..replay_recipe import ReplayRecipe


@dataclass(frozen=True, kw_only=True)
class SAC(ReplayRecipe, algorithm="sac", builds=f"{__package__}.algorithm:SACAlgorithm"):
    """Soft actor-critic (arXiv 1812.05905) with two critics and a learned temperature."""

    learning_rate: float = 3e-4
    """Learning rate of Adam for actor, critics and temperature."""
    tau: float = 0.005
    """Step of the target critics towards the critics at each gradient step, from 0 to 1."""
    critic: Literal["mlp", "backbone"] = "mlp"
    """Whether the critics read the newest observation, or each has a backbone with the actor's
    settings."""
    critic_hidden: tuple[int, ...] = (256, 256)
    """Widths of the critics' hidden layers."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(self, learning_rate=0, tau=0)
        check_at_most(self, tau=1)
        check_widths(self, "critic_hidden")
