"""Frames with which no step begins: the last frames of episodes."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor


class EndFrames:
    """A queue of frames, numbered from 0, in a table that grows when it is full.

    Args:
        like: Frames [N] that give the shapes and dtypes.

    Example:
        >>> frames = EndFrames(TensorDict({"observation": torch.zeros(1, 2)}, [1]))
        >>> frames.push(TensorDict({"observation": torch.arange(4.0).view(2, 2)}, [2]))
        tensor([0, 1])
        >>> frames.drop(1)
        >>> frames.read(1)["observation"]
        tensor([[2., 3.]])
    """

    def __init__(self, like: TensorDictBase) -> None:
        self.table = like[:1].clone()
        """Frame number n is in row n modulo the length."""
        self.first = 0
        """Number of the oldest frame."""
        self.stop = 0
        """Number of the newest frame, plus one."""

    def push(self, frames: TensorDictBase) -> Tensor:
        """Adds frames [N]; returns their numbers, int64 [N]."""
        numbers = torch.arange(self.stop, self.stop + len(frames))
        self.write(frames, numbers)
        return numbers

    def write(self, frames: TensorDictBase, numbers: Tensor) -> None:
        """Writes the newest frames [N], with consecutive numbers."""
        if not len(numbers):
            return
        stop = int(numbers[-1]) + 1
        if stop - self.first > len(self.table):
            kept = torch.arange(self.first, self.stop)
            table, self.table = self.table, self._room(2 * (stop - self.first))
            self._write(table[kept % len(table)], kept)
        self._write(frames, numbers)
        self.stop = max(self.stop, stop)

    def drop(self, count: int) -> None:
        """Forgets the oldest frames."""
        self.first += count

    def read(self, first: int) -> TensorDict:
        """Copies the frames from number ``first`` on."""
        return self.table[torch.arange(first, self.stop) % len(self.table)]

    def _write(self, frames: TensorDictBase, numbers: Tensor) -> None:
        self.table[numbers % len(self.table)] = frames

    def _room(self, count: int) -> TensorDict:
        return self.table[:1].expand(count).clone()
