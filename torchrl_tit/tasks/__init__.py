"""Tasks that require memory, registered with Gymnasium, and a wrapper for MiniGrid's tasks."""

from __future__ import annotations

import gymnasium

from torchrl_tit.tasks.first_actions import FirstActions
from torchrl_tit.tasks.t_maze import TMaze

__all__ = ["FirstActions", "TMaze"]

gymnasium.register("TMaze-v0", entry_point="torchrl_tit.tasks.t_maze:TMaze")
