"""Episodes of data that are shown to a policy as if it were in them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchrl_tit.datasets import Episodes, select_episodes

from .explained_page import as_picture

_HEIGHT = 84  # at least, of the picture of an array
_SHOWN = 84  # steps in it


class Recording:
    """Gives the observations and rewards of an episode, one after another.

    It is the ``feed`` of a :class:`~torchrl_tit.envs.given.GivenTask`.

    Args:
        episodes: the data.
        number: number of the episode.

    Raises:
        ValueError: if there is no such episode.
    """

    def __init__(self, episodes: Episodes, number: int) -> None:
        count = len(episodes.lengths)
        if not 0 <= number < count:
            raise ValueError(
                f"{episodes.source} has {count} episodes, so there is no episode {number}: choose "
                f"one below {count}"
            )
        rows = select_episodes(episodes, torch.tensor([number])).rows
        self._frames, self._rewards = rows["observation"], rows["reward"]
        self.actions: Tensor = rows["action"][:-1]
        """The actions of its steps, [T, ...]."""
        self._step = 0

    def __call__(self, begins: bool) -> dict[str, Tensor]:
        """Returns the next observation [1, *obs], with the reward before it."""
        self._step = 0 if begins else self._step + 1
        reward = self._rewards[self._step - 1 : self._step] if self._step else torch.zeros(1, 1)
        ends = torch.tensor([[self._step >= len(self.actions)]])
        frame = self._frames[self._step : self._step + 1]
        return {"observation": frame, "reward": reward.float(), "truncated": ends}

    def render(self) -> np.ndarray:
        """Draws an image as it is, and of an array the last steps, each entry a row."""
        frame = self._frames[self._step].numpy()
        if frame.ndim > 1:
            return as_picture(frame)[None]
        known = self._frames[:-1].float()
        low, high = known.amin(0), known.amax(0)
        shades = (known - low) / (high - low).clamp(min=1e-12)
        recent = shades[max(0, self._step + 1 - _SHOWN) : self._step + 1].T
        picture = np.zeros((len(recent), _SHOWN), np.uint8)
        picture[:, _SHOWN - recent.shape[1] :] = (55 + 200 * recent).byte().numpy()
        picture = picture.repeat(-(-_HEIGHT // len(picture)), 0)
        return np.stack([picture] * 3, -1)[None]
