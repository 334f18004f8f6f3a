"""Tasks that this package registers with Gymnasium, and wrappers of tasks."""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium import spaces

from torchrl_tit.tasks.previous_step import PreviousStep
from torchrl_tit.tasks.t_maze import TMaze

__all__ = ["FirstActions", "PreviousStep", "TMaze"]

gymnasium.register("TMaze-v0", entry_point="torchrl_tit.tasks.t_maze:TMaze")
for _game in ("asterix", "breakout", "freeway", "seaquest", "space_invaders"):
    # MinAtar's own names. Its package registers them only when asked to.
    gymnasium.register(
        f"MinAtar/{_game.title().replace('_', '')}-v1",
        entry_point="torchrl_tit.tasks.minatar:make_game",
        kwargs={"game": _game},
        max_episode_steps=10_000,  # a good agent's games of Breakout would not end
    )


class FirstActions(gymnasium.ActionWrapper[Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Keeps the first ``count`` actions of a Discrete task whose other actions are useless.

    MiniGrid gives every task the same seven actions. MiniGrid-Memory needs three: left, right and
    forward.

    Args:
        env: a task with Discrete actions.
        count: number of actions to keep.

    Raises:
        ValueError: if the task's actions are of another kind or fewer than ``count``.

    Example:
        >>> import gymnasium
        >>> FirstActions(gymnasium.make("Taxi-v4"), count=4).action_space
        Discrete(4)
    """

    def __init__(self, env: gymnasium.Env, count: int) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(self, count=count)
        super().__init__(env)
        space = env.action_space
        if not isinstance(space, spaces.Discrete):
            raise ValueError(f"FirstActions needs Discrete actions, not {space}")
        if not 1 <= count <= space.n:
            raise ValueError(f"count must be from 1 to {space.n}, the task's actions, not {count}")
        self.action_space = spaces.Discrete(count, start=space.start)

    def action(self, action: Any) -> Any:
        """Returns the action unchanged."""
        return action
