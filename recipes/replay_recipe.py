"""The base class of recipes that collect steps and learn from samples of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchrl_tit.settings.numbers import Batch, Copies, Fraction, Steps, Weight

from .online_recipe import OnlineRecipe
from .ray_cluster import check_address
from .recipe import Padding


@dataclass(frozen=True, kw_only=True)
class ReplayRecipe(OnlineRecipe):
    """Settings of every recipe that learns online from a replay buffer."""

    padding: Padding = "same"
    """What fills a history before the first observation: that observation, or zeros."""
    hide_velocities: bool = False
    """Whether to remove velocities from observations, so that one observation is not enough."""
    num_envs: Copies = 1
    """Number of environments; they share the steps of a batch."""
    collectors: Copies = 1
    """Number of collectors on a Ray cluster, each with its share of the environments."""
    ray: str | None = None
    """Address of a Ray cluster whose machines the collectors run on: auto, or HOST:PORT. See
    docs/recipes.md."""
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
    gamma: Fraction = 0.99
    """Discount factor."""
    log_interval: Steps = 1000
    """Environment steps between rows of metrics."""

    def __post_init__(self) -> None:
        super().__post_init__()
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
        check_address(self)
        if self.num_envs % self.collectors:
            raise ValueError(
                f"collectors {self.collectors} does not divide num_envs {self.num_envs}: change "
                "one of them"
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
    def final_step(self) -> int:
        """``total_steps``, rounded up to whole batches."""
        return math.ceil(self.total_steps / self.steps_per_batch) * self.steps_per_batch

    @property
    def updates_per_batch(self) -> int:
        """Gradient steps after each batch."""
        return max(1, round(self.steps_per_batch * self.updates_per_step))
