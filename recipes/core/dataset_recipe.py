"""The base class of recipes that train on a data set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from torchrl_tit.settings.choices import Gaps
from torchrl_tit.settings.numbers import Batch, Steps

from .recipe import Recipe


@dataclass(frozen=True, kw_only=True)
class DatasetRecipe(Recipe):
    """Settings of every recipe that trains on a data set and is evaluated in an environment."""

    offline: ClassVar[bool] = True

    dataset: str
    """A data set: a file in D4RL's layout, or the name of one of D4RL's or Minari's."""
    env: str
    """Name of the Gymnasium environment that the network is evaluated in."""
    max_episode_steps: Steps | None = None
    """Time limit of the task, for data files that do not record it; see docs/datasets.md."""
    gaps: Gaps = "error"
    """What to do if the next observation of a step in a data file is not the observation that
    follows: "error" refuses the data, "cut" ends the episode there."""
    batch_size: Batch = 64
    """Batch size of a gradient step."""
    log_interval: Steps = 100
    """Gradient steps between rows of metrics."""
    checkpoint_interval: Steps = 1000
    """Gradient steps between checkpoints."""

    def reading(self) -> dict[str, Any]:
        """How the data are read: arguments of :func:`~torchrl_tit.datasets.load_episodes`."""
        return {"task": self.env, "max_episode_steps": self.max_episode_steps, "gaps": self.gaps}
