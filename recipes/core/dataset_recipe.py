"""The base class of recipes that train on a data set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from torchrl_tit.settings.choices import Device, Gaps
from torchrl_tit.settings.numbers import Batch, Probability, Steps

from .recipe import Recipe


@dataclass(frozen=True, kw_only=True)
class DatasetRecipe(Recipe):
    """Settings of every recipe that trains on a data set.

    The policy is evaluated in an environment, if there is one, and measured on held-out episodes,
    if there are any.
    """

    offline: ClassVar[bool] = True

    dataset: str
    """A data set: a file in D4RL's layout, or the name of one of D4RL's or Minari's."""
    env: str = ""
    """Name of the Gymnasium environment that the network is evaluated in. Without one, the data
    alone say what observations and actions are, and env_settings records it."""
    validation_fraction: Probability | None = None
    """Share of the episodes that are held out of training and that the networks are measured on,
    chosen by the seed; by default a tenth without an environment, and none with one."""
    max_episode_steps: Steps | None = None
    """Time limit of the task, for data files that do not record it; see docs/datasets.md."""
    gaps: Gaps = "error"
    """What to do if the next observation of a step in a data file is not the observation that
    follows: "error" refuses the data, "cut" ends the episode there."""
    batch_size: Batch = 64
    """Batch size of a gradient step."""
    storage_device: Device = "cpu"
    """Device of the stored data, from which batches are moved to the networks; those on the CPU
    store data there, too. "cuda" is faster if all data fit on the GPU."""
    log_interval: Steps = 100
    """Gradient steps between rows of metrics."""
    checkpoint_interval: Steps = 1000
    """Gradient steps between checkpoints."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.env or self.held_out_fraction):
            raise ValueError(
                "validation_fraction is 0, and there is no environment, so nothing would tell how "
                "good the policy is: hold at least one episode out, such as 0.01 of them"
            )

    def reading(self) -> dict[str, Any]:
        """How the data are read: arguments of :func:`~torchrl_tit.datasets.load_episodes`."""
        return {
            "task": self.env or None,
            "max_episode_steps": self.max_episode_steps,
            "gaps": self.gaps,
        }

    @property
    def held_out_fraction(self) -> float:
        """The share of the episodes that are held out."""
        if self.validation_fraction is None:
            return 0.0 if self.env else 0.1
        return self.validation_fraction

    @property
    def task_name(self) -> str:
        """The environment's name; without one, that of the data."""
        return self.env or self.dataset or "the data"
