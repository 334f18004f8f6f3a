"""Decides which frames a window holds.

Each frame is stored once, as a row of a table. A window holds the newest frame and the K - 1 rows
before it, but never a row of another episode: padding replaces rows before the oldest valid one.
All windows are cut here: those of training segments, of rollouts, and of replay buffers of data
sets and environments.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_tit.settings.choices import Padding


class Windows(NamedTuple):
    """The rows of a table of frames that each window holds.

    Example:
        >>> newest, oldest = torch.tensor([3, 4]), torch.tensor([2, 4])
        >>> find_windows(newest, oldest, num_frames=3, padding="same").rows
        tensor([[2, 2, 3],
                [4, 4, 4]])
    """

    rows: Tensor
    """int64 [..., K], oldest frame first; a missing frame has the row of the oldest valid one."""
    missing: Tensor | None
    """bool [..., K], True where zeros replace a missing frame; None if they replace none."""
    span: int | None = None
    """If the windows are those of N sequences, [N, T, K], the rows of each sequence: those of
    sequence n are n * span to (n + 1) * span - 1, in the order of time. None otherwise."""

    def used(self) -> tuple[Tensor, Windows]:
        """Finds the rows that are used, so that only those are encoded.

        Returns:
            The rows, int64 [U], and the same windows on a table of these U rows.

        Example:
            >>> rows, windows = Windows(torch.tensor([[7, 7, 9]]), None).used()
            >>> rows, windows.rows
            (tensor([7, 9]), tensor([[0, 0, 1]]))
        """
        rows, renumbered = self.rows.unique(return_inverse=True)
        return rows, Windows(renumbered, self.missing)

    def padded(self) -> Tensor:
        """Finds where padding repeats a row, instead of one row following another.

        Returns:
            bool [..., K].

        Example:
            >>> Windows(torch.tensor([[2, 2, 3], [3, 4, 5]]), None).padded().tolist()
            [[True, False, False], [False, False, False]]
        """
        steps = torch.arange(1 - self.rows.shape[-1], 1, device=self.rows.device)
        return self.rows != self.rows[..., -1:] + steps

    def newest(self, num_frames: int) -> Windows:
        """The same windows, of only their newest frames, [..., num_frames]."""
        missing = None if self.missing is None else self.missing[..., -num_frames:]
        return Windows(self.rows[..., -num_frames:], missing, self.span)

    def of_every_row(self, count: int, num_frames: int) -> Windows:
        """Finds a shorter window for every frame that a window holds, not only for the newest ones.

        Only for windows of sequences whose newest frames follow one another.

        Args:
            count: number R of rows of the table.
            num_frames: number A <= K of frames of a shorter window.

        Returns:
            Windows [N, span, A]. A row that only the A - 1 oldest frames of windows have is
            repeated.

        Example:
            >>> windows = Windows(torch.tensor([[[0, 1, 2], [1, 2, 3]]]), None, span=4)
            >>> windows.of_every_row(count=4, num_frames=2).rows.tolist()
            [[[0, 0], [0, 1], [1, 2], [2, 3]]]
        """
        found = torch.arange(count, device=self.rows.device).unsqueeze(-1).repeat(1, num_frames)
        for rows in (self.rows[:, 0].unfold(-1, num_frames, 1), self.rows[..., -num_frames:]):
            found[rows[..., -1].flatten()] = rows.flatten(0, -2)
        span, sequences = self.span or 0, self.rows.shape[0]
        return Windows(found[: sequences * span].view(sequences, span, -1), None, span)

    def gather(self, frames: Tensor) -> Tensor:
        """Gathers frames.

        Args:
            frames: [R, *frame], of any dtype.

        Returns:
            [..., K, *frame], a copy.
        """
        windows = take(frames, self.rows)
        if self.missing is None:
            return windows
        missing = self.missing.view(*self.missing.shape, *[1] * (frames.ndim - 1))
        return windows.masked_fill(missing, 0)


def take(table: Tensor, rows: Tensor) -> Tensor:
    """Gathers rows of a table with ``index_select``, on a CPU several times faster than indexing.

    Args:
        table: [R, *entry].
        rows: int64 [...].

    Returns:
        [..., *entry], a copy.
    """
    return table.index_select(0, rows.flatten()).view((*rows.shape, *table.shape[1:]))


def differs(one: Tensor, other: Tensor, ndim: int = 2) -> Tensor:
    """Where observations differ, [*B, *obs] each -> bool [*B] of ndim dimensions; NaN equals NaN.

    Example:
        >>> differs(torch.tensor([[[1.0, torch.nan]]]), torch.tensor([[[2.0, torch.nan]]]))
        tensor([[True]])
    """
    different = (one != other) & ((one == one) | (other == other))
    return different.unsqueeze(-1).flatten(ndim).any(-1)


def find_windows(newest: Tensor, oldest: Tensor, num_frames: int, padding: Padding) -> Windows:
    """Finds the rows of windows.

    Args:
        newest: row of the newest frame of each window, int64 [...].
        oldest: first valid row of each window, such as that of its episode's first frame, int64
            [...]; at most ``newest``.
        num_frames: number K of frames in a window.
        padding: what replaces frames before ``oldest``: that frame, or zeros.
    """
    steps = torch.arange(1 - num_frames, 1, device=newest.device)
    rows = newest.unsqueeze(-1) + steps
    oldest = oldest.unsqueeze(-1)
    missing = rows < oldest if padding == "constant" and num_frames > 1 else None
    return Windows(rows.maximum(oldest), missing)
