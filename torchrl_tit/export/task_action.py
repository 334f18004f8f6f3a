"""Converts actions to those of the task."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_tit.envs.actions import ActionWriter


class TaskAction(nn.Module):
    """Clips, shifts, rounds and reshapes actions like :class:`~torchrl_tit.envs.GymVectorEnv`.

    Args:
        writer: the environment's action writer.

    Example:
        >>> from gymnasium.spaces import Box
        >>> TaskAction(ActionWriter(Box(-1, 1, (2,)), clip=True))(torch.tensor([[3.0, 0.5]]))
        tensor([[1.0000, 0.5000]])
    """

    def __init__(self, writer: ActionWriter) -> None:
        super().__init__()
        self.shape = writer.shape
        self.clips = writer.bounds is not None
        integers = writer.dtype
        self.dtype = None if integers is None else torch.from_numpy(np.zeros(1, integers)).dtype
        if writer.bounds is not None:
            low, high = map(torch.from_numpy, writer.bounds)
            self.register_buffer("low", low)
            self.register_buffer("high", high)
        self.start: Tensor | None
        start = None if writer.start is None else torch.as_tensor(writer.start)
        self.register_buffer("start", start)

    def forward(self, action: Tensor) -> Tensor:
        """[N, *spec] -> [N, *space]."""
        if self.dtype is not None:
            action = self._round(action, self.dtype)
        elif self.clips:
            action = action.clamp(self.get_buffer("low"), self.get_buffer("high"))
        if self.start is not None:
            action = action + self.start
        return action if self.shape is None else action.reshape(action.shape[0], *self.shape)

    def _round(self, action: Tensor, dtype: torch.dtype) -> Tensor:
        low, high = self.get_buffer("low"), self.get_buffer("high")
        action = action.round()
        below, above = action <= low, action >= high
        inside = torch.where(below | above, 0, action).to(dtype)
        return torch.where(below, low, torch.where(above, high, inside))
