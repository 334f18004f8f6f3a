"""The state of a replay buffer, as parts on the disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torchrl.data import ReplayBuffer

from torchrl_tit.checkpoint import load_checkpoint, remove_checkpoint, save_checkpoint
from torchrl_tit.datasets import OnlineHistoryStorage


class BufferState:
    """The state of a replay buffer, as parts on the disk.

    Each checkpoint writes the steps since the one before, each frame once, and lists the parts that
    belong to it. A checkpoint that held all steps itself would be as large as the buffer. Parts
    whose steps were overwritten are removed, once no checkpoint that is kept needs them.

    Args:
        buffer: a buffer with an :class:`~torchrl_tit.datasets.OnlineHistoryStorage` and TorchRL's
            default writer. Its sampler has no state of its own.
        folder: folder of the parts, each numbered by the total number of steps at its end.
        checkpoints: how many checkpoints are kept.
    """

    def __init__(self, buffer: ReplayBuffer, folder: Path, checkpoints: int = 3) -> None:
        self.buffer = buffer
        self.storage: OnlineHistoryStorage = buffer.storage
        self.folder = folder
        self.checkpoints = checkpoints
        self._parts: list[int] = []  # on the disk

    def state_dict(self) -> dict[str, Any]:
        """Writes the new steps, and returns the numbers of the parts."""
        before, count = max(self._parts, default=0), self.storage.num_written
        if count > before:
            save_checkpoint(self.folder, count, self.storage.part(before), keep=count)
            self._parts.append(count)
            # The checkpoint of this part is not there yet; the ones before it are.
            kept = self._needed(self._parts[-self.checkpoints - 1 :][0])
            for number in set(self._parts) - set(kept):
                remove_checkpoint(self.folder, number)
            self._parts = kept
        needed = self._needed(count)
        return {
            "parts": needed,
            "older_parts": [number for number in self._parts if number not in needed],
            "writer": self.buffer.writer.state_dict(),
        }

    def load_state_dict(self, state_dict: dict[str, Any], /) -> None:
        """Reads a checkpoint's parts. Other parts belong to lost work and will be replaced."""
        self._parts = [*state_dict["older_parts"], *state_dict["parts"]]
        for number in state_dict["parts"]:
            self.storage.add_part(load_checkpoint(self.folder, number)[1])
        self.buffer.writer.load_state_dict(state_dict["writer"])

    def _needed(self, count: int) -> list[int]:
        """The parts that the buffer's items need once ``count`` steps are written."""
        return [number for number in self._parts if number > count - self.storage.reach]
