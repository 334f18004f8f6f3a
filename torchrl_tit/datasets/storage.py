"""A TorchRL storage that gathers samples from episodes when they are drawn."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, NoReturn

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import Storage

from torchrl_tit.datasets.episodes import Episodes
from torchrl_tit.datasets.errors import DatasetError


class EpisodeStorage(Storage):
    """A read-only storage with one item for each step of episodes.

    Any TorchRL sampler can draw the indices; uniform sampling of indices is uniform over steps.
    Consecutive indices are consecutive steps, the last of an episode followed by the next episode.

    Args:
        episodes: The data, on the device where items are gathered.
        counts: Number of steps of each episode, from its first, that are items; int64 [E].

    Raises:
        DatasetError: If no step is left.
    """

    def __init__(self, episodes: Episodes, counts: Tensor) -> None:
        super().__init__(max_size=int(counts.sum()))
        if self.max_size == 0:
            raise DatasetError(
                episodes.source,
                f"nothing can be drawn from its {len(episodes.lengths)} episodes: none is "
                f"finished, or all their transitions are left out.",
            )
        self.device = episodes.lengths.device
        self._fields = dict(episodes.rows.items())  # [R, ...]
        self._first_rows = episodes.first_rows
        self._ends = counts.cumsum(0)  # [E]: index after the last item of each episode
        self._shifts = episodes.first_rows - (self._ends - counts)  # [E]: row minus index

    def get(self, index: int | slice | Sequence[int] | Tensor) -> TensorDict:
        """Gathers items.

        Args:
            index: Indices of items; negative ones count from the end.

        Returns:
            The items, with the shape of the index.

        Raises:
            IndexError: If there is no such item (on a CPU; elsewhere that is not checked).
        """
        index = as_indices(index, len(self), self.device)
        episode = torch.searchsorted(self._ends, index, right=True)
        return self._cut(index + self._shifts[episode], episode)

    @abstractmethod
    def _cut(self, row: Tensor, episode: Tensor) -> TensorDict:
        """Gathers the items of these rows and episodes, int64 [...] each."""

    def _take(self, name: str, rows: Tensor) -> Tensor:
        """Rows of a field."""
        return take(self._fields[name], rows)

    def __len__(self) -> int:
        return self.max_size

    def set(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuses to write."""
        raise RuntimeError("A data set cannot be written to.")

    def _empty(self) -> NoReturn:
        raise RuntimeError("A data set cannot be emptied.")

    def state_dict(self) -> dict[str, Any]:
        """Returns what identifies the data, which are not part of the state."""
        return {"num_items": len(self)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Checks that a state was saved with the same data.

        Args:
            state_dict: A return value of `state_dict`.

        Raises:
            ValueError: If it was saved with other data.
        """
        if state_dict["num_items"] != len(self):
            raise ValueError(
                f"The state was saved with {state_dict['num_items']} items, but there are "
                f"{len(self)}; load the same data with the same settings."
            )


def as_indices(index: Any, count: int, device: torch.device) -> Tensor:
    """Converts the index of items to int64 indices from 0 on.

    Args:
        index: an integer, slice, sequence or tensor; negative ones count from the end.
        count: number of items.
        device: where they are.

    Raises:
        IndexError: If there is no such item (on a CPU; elsewhere that is not checked).

    Example:
        >>> as_indices([0, -1], 5, torch.device("cpu"))
        tensor([0, 4])
    """
    if isinstance(index, slice):
        return torch.arange(*index.indices(count), device=device)
    index = torch.as_tensor(index, device=device)
    if index.device.type != "cpu":  # reading the values would synchronize
        return torch.where(index < 0, index + count, index)
    if not index.numel():
        return index
    low, high = map(int, index.aminmax())
    if low < -count or high >= count:
        raise IndexError(f"There are {count} items, and none at {low} or {high}.")
    return torch.where(index < 0, index + count, index) if low < 0 else index


def take(table: Tensor, rows: Tensor) -> Tensor:
    """Gathers rows; ``index_select`` is several times as fast as indexing.

    Args:
        table: [R, *entry].
        rows: int64 [...].

    Returns:
        [..., *entry].
    """
    return table.index_select(0, rows.flatten()).view((*rows.shape, *table.shape[1:]))
