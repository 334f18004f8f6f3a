"""A hint for users whose network reads more frames than their task's episodes have."""

from __future__ import annotations

import warnings
from collections import defaultdict
from typing import Any

from ..core.callback import Callback
from ..core.recipe import Recipe

_SHARE = 5
"""A run is checked after one part in this many, because the first episodes are often short."""
_ENOUGH = 100
"""Minimum number of episodes for a warning."""


class UnusedFrames(Callback):
    """Warns once if no episode in the first fifth of a run was as long as the history.

    Args:
        recipe: the settings of a run that learns from steps it collects.
    """

    def __init__(self, recipe: Recipe) -> None:
        self._num_frames = recipe.backbone.num_frames
        self._judged_at = recipe.final_step // _SHARE
        self._over = self._num_frames == 1
        self._running: defaultdict[int, int] = defaultdict(int)  # by environment
        self._longest = self._episodes = 0

    def collected(self, step: int, batch: Any) -> None:
        """Measures the episodes of a batch [envs, time], and warns when it is time."""
        if self._over:
            return
        for env, dones in enumerate(batch["next", "done"].squeeze(-1).tolist()):
            for done in dones:
                self._running[env] += 1
                self._longest = max(self._longest, self._running[env])
                if done:
                    self._running[env] = 0
                    self._episodes += 1
        self._over = self._longest >= self._num_frames or step >= self._judged_at
        if self._longest < self._num_frames and self._over and self._episodes >= _ENOUGH:
            warnings.warn(
                f"num_frames is {self._num_frames}, but no episode so far had more than "
                f"{self._longest} steps: with num_frames {self._longest} the network sees as much, "
                "and trains faster",
                stacklevel=1,
            )
