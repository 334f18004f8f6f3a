"""The one place where it is decided which frames a window holds.

Frames are kept once, in rows. A window is the newest frame and the K - 1 rows before it, but never
one of another episode: padding takes the place of rows before the oldest one that belongs. Training
on segments, rollouts, and replay buffers of data sets and of environments all cut windows here.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

Padding = Literal["same", "constant"]
"""What fills the steps before an episode's first: that observation ("same"), or zeros ("constant").
"""


class Windows(NamedTuple):
    """Which rows of a table of frames some windows hold.

    Example:
        >>> newest, oldest = torch.tensor([3, 4]), torch.tensor([2, 4])
        >>> find_windows(newest, oldest, num_frames=3, padding="same").rows
        tensor([[2, 2, 3],
                [4, 4, 4]])
    """

    rows: Tensor
    """int64 [..., K], the oldest frame first; where a frame is missing, the oldest that belongs."""
    missing: Tensor | None
    """bool [..., K], True where zeros take the place of a missing frame; None if nothing does."""

    def used(self) -> tuple[Tensor, Windows]:
        """Finds the rows that are used at all, to encode only those.

        Returns:
            The rows, int64 [U], and the same windows on a table of these U rows.

        Example:
            >>> rows, windows = Windows(torch.tensor([[7, 7, 9]]), None).used()
            >>> rows, windows.rows
            (tensor([7, 9]), tensor([[0, 0, 1]]))
        """
        rows, renumbered = self.rows.unique(return_inverse=True)
        return rows, Windows(renumbered, self.missing)

    def gather(self, frames: Tensor) -> Tensor:
        """Gathers frames.

        Args:
            frames: [R, *frame], of any dtype.

        Returns:
            [..., K, *frame], a copy.
        """
        # index_select is several times as fast as indexing, on a CPU.
        windows = frames.index_select(0, self.rows.flatten())
        windows = windows.view(*self.rows.shape, *frames.shape[1:])
        if self.missing is None:
            return windows
        missing = self.missing.view(*self.missing.shape, *[1] * (frames.ndim - 1))
        return windows.masked_fill(missing, 0)


def find_windows(
    newest: Tensor, oldest: Tensor, num_frames: int, padding: Padding, stride: int = 1
) -> Windows:
    """Finds the rows of windows.

    Args:
        newest: row of the newest frame of each window, int64 [...].
        oldest: the first row that belongs to it, such as that of its episode's first frame, int64
            [...]; at most ``newest``.
        num_frames: number K of frames in a window.
        padding: what takes the place of frames before ``oldest``: that frame, or zeros.
        stride: rows from one step to the next, if the steps of several environments take turns.
    """
    steps = torch.arange(1 - num_frames, 1, device=newest.device) * stride
    rows = newest.unsqueeze(-1) + steps
    oldest = oldest.unsqueeze(-1)
    missing = rows < oldest if padding == "constant" and num_frames > 1 else None
    return Windows(rows.maximum(oldest), missing)
