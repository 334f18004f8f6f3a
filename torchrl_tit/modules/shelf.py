"""The last entries of a sequence, at the cost of writing one a step."""

from __future__ import annotations

from torch import Tensor


class Shelf:
    """The last entries of a sequence, each written once: the oldest goes when a new one comes.

    Args:
        entries: [N, M, ...], of which a copy is kept.

    Example:
        >>> import torch
        >>> shelf = Shelf(torch.tensor([[1, 2, 3]]))
        >>> shelf.append(torch.tensor([4]))
        >>> shelf.entries
        tensor([[2, 3, 4]])
    """

    def __init__(self, entries: Tensor) -> None:
        self._count = entries.shape[1]
        # Twice the room: all are moved to the front only when the end is reached.
        self._room = entries.new_empty(len(entries), 2 * self._count, *entries.shape[2:])
        self._room[:, : self._count] = entries
        self._start = 0

    @property
    def entries(self) -> Tensor:
        """The entries, [N, M, ...], as a view."""
        return self._room[:, self._start : self._start + self._count]

    def append(self, entry: Tensor) -> None:
        """Takes an entry [N, ...] in the place of the oldest."""
        if self._start == self._count:
            self._room[:, : self._count] = self.entries
            self._start = 0
        self._room[:, self._start + self._count] = entry
        self._start += 1
