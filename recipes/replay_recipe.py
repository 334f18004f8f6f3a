"""The base class of recipes that collect steps and learn from samples of them."""

from __future__ import annotations

from dataclasses import dataclass

from torchrl_tit.settings.numbers import Batch, Steps, Weight

from .online import OnlineRecipe


@dataclass(frozen=True, kw_only=True)
class ReplayRecipe(OnlineRecipe):
    """Settings of every recipe that learns online from a replay buffer."""

    total_steps: Steps = 1_000_000
    """Environment steps to train for, rounded up to whole batches."""
    random_steps: Steps = 1000
    """Steps at the start with uniformly random actions, during which nothing is learned; must be a
    multiple of steps_per_batch."""
    steps_per_batch: Batch = 50
    """Environment steps between two rounds of gradient steps; must be a multiple of num_envs."""
    updates_per_step: Weight = 1.0
    """Gradient steps for each environment step."""
    buffer_size: Batch = 1_000_000
    """Capacity of the replay buffer in steps; when it is full, new steps replace the oldest."""
    batch_size: Batch = 256
    """Transitions in one gradient step, sampled with replacement from the buffer."""
    slice_length: Batch = 1
    """Number of consecutive steps that are drawn together, so that a backbone encodes their frames
    once; must divide batch_size. 1 draws transitions one by one."""
    log_interval: Steps = 1000
    """Environment steps between rows of metrics."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.random_steps % self.steps_per_batch:
            raise ValueError(
                f"random_steps {self.random_steps} must be a multiple of steps_per_batch "
                f"{self.steps_per_batch}"
            )
        if self.collectors > 1 and self.ray is None:
            raise ValueError(
                f"collectors is {self.collectors}, but {self.algorithm} collects in one process, "
                "or on a Ray cluster: set ray to its address, such as auto, or collectors to 1"
            )
        if self.batch_size % self.slice_length:
            raise ValueError(
                f"slice_length {self.slice_length} does not divide batch_size {self.batch_size}: "
                "change one of them"
            )
        if self.buffer_size < max(self.steps_per_batch, self.slice_length * self.num_envs):
            raise ValueError(
                f"buffer_size {self.buffer_size} has no room for a batch of {self.steps_per_batch} "
                "steps and a slice of each environment: make it larger"
            )
        if self.slice_length * self.num_envs > self.random_steps:
            raise ValueError(
                f"slice_length {self.slice_length} is longer than the {self.random_steps} "
                f"random_steps of {self.num_envs} environments: change one of them"
            )
        if self.backbone.carries_state:
            raise ValueError(
                f"{self.algorithm} draws single transitions, so its network cannot carry a state: "
                "set backbone.num_frames to 2 or more, or use a ppo recipe"
            )

    @property
    def updates_per_batch(self) -> int:
        """Gradient steps after each batch."""
        return max(1, round(self.steps_per_batch * self.updates_per_step))
