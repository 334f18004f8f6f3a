"""The passive T-Maze: a cue at the first step decides where to turn at the last one."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

_MOVES = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])  # right, up, left, down


class TMaze(gymnasium.Env[np.ndarray, np.int64]):
    """A corridor where the agent must remember a cue and turn to its side at the end.

    The agent starts at one end of a corridor, where it sees on which side the goal is: up or down.
    At the other end, the junction, it turns. An episode is as long as the shortest path to a goal,
    so only memory decides between a return of 1 and one of 0: walking straight on and guessing
    gives 0.5 on average. A step that falls behind the shortest path costs ``1 / corridor_length``.

    Ni et al., "When Do Transformers Shine in RL? Decoupling Memory from Credit Assignment", arXiv
    2307.03864, section 5.1, after Bakker, "Reinforcement Learning with Long Short-Term Memory",
    NeurIPS 2001.

    - **Observation**, float32 [2]: 1 from the junction on, else 0; and at the first step the goal's
      side, 1 (up) or -1 (down), in the corridor 0, after the turn the agent's side.
    - **Action**, Discrete(4): right, up, left, down. Against a wall the agent stays.
    - **Reward**: at the last step 1 at the goal, else 0; before it 0, or the cost.
    - **Terminated** after ``corridor_length + 1`` steps, or earlier with ``end_when_behind``; never
      truncated.

    Args:
        corridor_length: steps from the start to the junction, at least 1.
        end_when_behind: whether the first step that falls behind ends the episode, at the cost of
            all remaining ones. No action makes up for such a step, so each episode returns the
            same; but what a mistake costs is known at once, however long the corridor is.

    Raises:
        ValueError: if the length is not a positive integer, or ``end_when_behind`` is not a bool.

    Example:
        >>> import gymnasium
        >>> env = gymnasium.make("TMaze-v0", corridor_length=2)
        >>> observation, _ = env.reset(seed=0)
        >>> up = observation[1] > 0
        >>> for action in (0, 0, 1 if up else 3):
        ...     observation, reward, terminated, _, _ = env.step(action)
        >>> reward, terminated
        (1.0, True)
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 15}  # noqa: RUF012

    def __init__(
        self,
        corridor_length: int = 10,
        render_mode: str | None = None,
        end_when_behind: bool = False,
    ) -> None:
        if type(corridor_length) is not int or corridor_length < 1:
            raise ValueError(f"corridor_length must be an integer from 1 on, not {corridor_length}")
        if type(end_when_behind) is not bool:
            raise ValueError(f"end_when_behind must be True or False, not {end_when_behind!r}")
        self.corridor_length = corridor_length
        self.end_when_behind = end_when_behind
        self.render_mode = render_mode
        self.observation_space = spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = spaces.Discrete(4)
        self._x = self._y = self._goal = self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Puts the agent at the start and draws the goal's side."""
        super().reset(seed=seed)
        self._x = self._y = self._steps = 0
        self._goal = int(self.np_random.choice([-1, 1]))
        return self._observe(), {}

    def step(self, action: np.int64) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Moves, unless a wall is in the way; the last step is rewarded at the goal."""
        right, up = _MOVES[action]
        self._steps += 1
        at_junction = self._x == self.corridor_length
        if right:
            self._x = min(max(self._x + int(right), 0), self.corridor_length)
        elif up and at_junction:
            self._y = int(up)  # at the last step: all others are needed to reach the junction
        left = self.corridor_length + 1 - self._steps
        behind = self._x < self._steps
        if not left:
            reward = float(self._y == self._goal)
        elif behind:
            reward = -(left if self.end_when_behind else 1) / self.corridor_length
        else:
            reward = 0.0
        over = not left or (behind and self.end_when_behind)
        return self._observe(), reward, over, False, {}

    def render(self) -> np.ndarray | None:
        """Draws the maze from above, the goal green and the agent red: uint8 [H, W, 3]."""
        if self.render_mode is None:
            return None
        tiles = np.zeros((5, self.corridor_length + 3, 3), np.uint8)
        tiles[2, 1:-1] = tiles[1:4, -2] = 255
        tiles[2 - self._goal, -2] = (0, 160, 0)
        tiles[2 - self._y, 1 + self._x] = (200, 0, 0)
        return tiles.repeat(8, 0).repeat(8, 1)

    def _observe(self) -> np.ndarray:
        side = self._goal if self._steps == 0 else self._y
        return np.array([self._x == self.corridor_length, side], np.float32)
