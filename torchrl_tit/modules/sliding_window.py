"""Keeps the last entries of a sequence by writing one entry per step."""

from __future__ import annotations

from torch import Tensor


class SlidingWindow:
    """The last M entries of a sequence: appending one drops the oldest.

    Args:
        entries: the first M entries, [N, M, ...], which are copied.

    Example:
        >>> import torch
        >>> window = SlidingWindow(torch.tensor([[1, 2, 3]]))
        >>> window.append(torch.tensor([4]))
        >>> window.entries
        tensor([[2, 3, 4]])
    """

    def __init__(self, entries: Tensor) -> None:
        self._count = entries.shape[1]
        # Room for 2 M entries, so that they move to the front only when the end is reached.
        self._room = entries.new_empty(len(entries), 2 * self._count, *entries.shape[2:])
        self._room[:, : self._count] = entries
        self._start = 0

    @property
    def entries(self) -> Tensor:
        """The entries, [N, M, ...], as a view."""
        return self._room[:, self._start : self._start + self._count]

    def append(self, entry: Tensor) -> None:
        """Appends an entry [N, ...] and drops the oldest."""
        if self._start == self._count:
            self._room[:, : self._count] = self.entries
            self._start = 0
        self._room[:, self._start + self._count] = entry
        self._start += 1
