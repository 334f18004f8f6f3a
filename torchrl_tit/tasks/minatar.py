"""MinAtar's games as Gymnasium tasks."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from torchrl_tit.extras import missing

_PIXELS = 16  # along the side of a cell, in a film


def make_game(game: str, render_mode: str | None = None, **settings: Any) -> gymnasium.Env:
    """Makes a game of MinAtar with the actions that matter in it (its version "v1").

    Observations are bool [10, 10, C]: a channel for each kind of object. Actions are sticky with
    probability 0.1, and games become harder, unless the settings say otherwise.

    Young and Tian, "MinAtar: An Atari-Inspired Testbed for Thorough and Reproducible Reinforcement
    Learning Experiments", arXiv 1903.03176.

    Args:
        game: asterix, breakout, freeway, seaquest or space_invaders.
        render_mode: "rgb_array", or None.
        **settings: ``sticky_action_prob`` and ``difficulty_ramping``.

    Returns:
        The game, whose render() is uint8 [160, 160, 3].

    Raises:
        ValueError: if the package minatar is missing.

    Example:
        >>> make_game("breakout", sticky_action_prob=0.0).observation_space.shape
        (10, 10, 4)
    """
    try:
        from minatar.gym import BaseEnv  # an optional extra
    except ImportError as error:
        raise ValueError(f"{missing('minatar')} ({error})") from error

    class Game(BaseEnv):
        metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012

        def reset(self, **settings: Any) -> tuple[np.ndarray, dict[str, Any]]:
            if settings.get("seed") is not None:
                self.game.last_action = 0  # else the first action might be one of a game before
            return super().reset(**settings)

        def render(self) -> np.ndarray:
            cells = (255 * super().render()).astype(np.uint8)  # its colors are from 0 to 1
            return cells.repeat(_PIXELS, 0).repeat(_PIXELS, 1)

    return Game(game, render_mode, use_minimal_action_set=True, **settings)
