"""Settings of DQN; the algorithm is in algorithm.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from torchrl_tit.settings.numbers import Batch, Fraction, Rate, Steps, Weight

from ..replay_recipe import ReplayRecipe


@dataclass(frozen=True, kw_only=True)
class DQN(ReplayRecipe, algorithm="dqn"):
    """Deep Q-networks (Mnih et al., Nature 518, 2015), with double Q-learning (arXiv 1509.06461).

    The defaults are those of CleanRL for classic control.
    """

    total_steps: Steps = 500_000
    """Environment steps to train for, rounded up to whole batches."""
    random_steps: Steps = 10_000
    """Steps at the start with uniformly random actions, during which nothing is learned; must be a
    multiple of steps_per_batch."""
    steps_per_batch: Batch = 10
    """Environment steps between two rounds of gradient steps; must be a multiple of num_envs."""
    updates_per_step: Weight = 0.1
    """Gradient steps for each environment step."""
    buffer_size: Batch = 10_000
    """Capacity of the replay buffer in steps; when it is full, new steps replace the oldest."""
    batch_size: Batch = 128
    """Transitions in one gradient step, sampled with replacement from the buffer."""
    learning_rate: Rate = 2.5e-4
    """Learning rate of Adam."""
    double: bool = True
    """Whether the trained network chooses the next action and the target network evaluates it
    (double Q-learning); otherwise the target network does both."""
    loss_function: Literal["l2", "smooth_l1"] = "l2"
    """Loss on the temporal difference error: its square, or the Huber loss, whose gradient is
    clipped as in the Nature paper."""
    final_epsilon: Fraction = 0.05
    """Probability of a random action at the end of exploration; at the start it is 1."""
    exploration_fraction: Fraction = 0.5
    """Fraction of all steps over which that probability falls linearly, after the random steps."""
    target_interval: Steps = 50
    """Gradient steps between updates of the target network."""
    tau: Fraction = 1.0
    """Coefficient of the soft update of the target network; 1 copies the network."""
    mask_actions: bool = False
    """Whether to mask actions that the task does not allow; see docs/environments.md."""
    clip_rewards: bool = False
    """Whether the network learns from the signs of rewards, as is usual for Atari."""

    def build(self) -> Any:
        """Builds the algorithm."""
        from .algorithm import DQNAlgorithm

        return DQNAlgorithm(self)

    @property
    def schedules(self) -> tuple[str, ...]:
        """Exploration, which takes a fraction of the run."""
        return ("exploration_fraction",) if self.exploration_fraction else ()

    @property
    def exploration_steps(self) -> int:
        """Environment steps from the first to the last value of epsilon, at least 1."""
        return max(1, round(self.exploration_fraction * self.final_step))
