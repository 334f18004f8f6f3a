"""Settings of SAC; the algorithm is in algorithm.py."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from torchrl_tit.settings.checks import check_at_least, check_at_most

from ..recipe import Padding, Recipe


@dataclass(frozen=True, kw_only=True)
class SAC(Recipe, algorithm="sac", builds=f"{__package__}.algorithm:SACAlgorithm"):
    """Soft actor-critic (arXiv 1812.05905) with two critics and a learned temperature."""

    padding: Padding = "same"
    """What fills a history before the first observation: that observation, or zeros."""
    hide_velocities: bool = False
    """Whether observations lack the velocities, so that one observation is not enough."""
    num_envs: int = 1
    """Number of environments; they share the steps of a batch."""
    total_steps: int = 1_000_000
    """Environment steps to train for, rounded up to whole batches."""
    random_steps: int = 1000
    """Steps at the start with uniformly random actions, during which nothing is learned; must be a
    multiple of steps_per_batch."""
    steps_per_batch: int = 50
    """Environment steps between two rounds of gradient steps; must be a multiple of num_envs."""
    updates_per_step: float = 1.0
    """Gradient steps for each environment step."""
    batch_size: int = 256
    """Transitions in one gradient step, sampled with replacement from all seen so far."""
    slice_length: int = 1
    """Consecutive steps that are drawn together, so that a backbone encodes their frames once; must
    divide batch_size. 1 draws transitions one by one."""
    learning_rate: float = 3e-4
    """Learning rate of Adam for actor, critics and temperature."""
    gamma: float = 0.99
    """Discount factor."""
    tau: float = 0.005
    """Step of the target critics towards the critics at each gradient step, from 0 to 1."""
    critic: Literal["mlp", "backbone"] = "mlp"
    """Whether the critics read the newest observation, or each has a backbone with the actor's
    settings."""
    critic_hidden: tuple[int, ...] = (256, 256)
    """Widths of the critics' hidden layers."""
    log_interval: int = 1000
    """Environment steps between rows of metrics."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(
            self,
            num_envs=1,
            total_steps=1,
            random_steps=1,
            steps_per_batch=1,
            updates_per_step=0,
            batch_size=1,
            slice_length=1,
            learning_rate=0,
            gamma=0,
            tau=0,
        )
        check_at_most(self, gamma=1, tau=1)
        if self.random_steps % self.steps_per_batch:
            raise ValueError(
                f"random_steps {self.random_steps} must be a multiple of steps_per_batch "
                f"{self.steps_per_batch}"
            )
        if self.steps_per_batch % self.num_envs:
            raise ValueError(
                f"steps_per_batch {self.steps_per_batch} must be a multiple of num_envs "
                f"{self.num_envs}"
            )
        if self.batch_size % self.slice_length:
            raise ValueError(
                f"slice_length {self.slice_length} does not divide batch_size {self.batch_size}: "
                "change one of them"
            )
        if self.slice_length * self.num_envs > self.random_steps:
            raise ValueError(
                f"slice_length {self.slice_length} is longer than the {self.random_steps} "
                f"random_steps of {self.num_envs} environments: change one of them"
            )
        if not self.critic_hidden or min(self.critic_hidden) < 1:
            raise ValueError(
                f"critic_hidden must be at least one width of at least 1, not {self.critic_hidden}"
            )
        if self.backbone.carries_state:
            raise ValueError(
                "sac draws single transitions, so its network cannot carry a state: set "
                "backbone.num_frames to 2 or more, or use a ppo recipe"
            )

    @property
    def final_step(self) -> int:
        """``total_steps``, rounded up to whole batches."""
        return math.ceil(self.total_steps / self.steps_per_batch) * self.steps_per_batch
