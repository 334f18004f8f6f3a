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
        index = self._as_tensor(index)
        episode = torch.searchsorted(self._ends, index, right=True)
        return self._cut(index + self._shifts[episode], episode)

    @abstractmethod
    def _cut(self, row: Tensor, episode: Tensor) -> TensorDict:
        """Gathers the items of these rows and episodes, int64 [...] each."""

    def _take(self, name: str, rows: Tensor) -> Tensor:
        """Rows of a field; index_select is several times as fast as indexing."""
        field = self._fields[name]
        return field.index_select(0, rows.flatten()).view(*rows.shape, *field.shape[1:])

    def _as_tensor(self, index: Any) -> Tensor:
        if isinstance(index, slice):
            return torch.arange(*index.indices(len(self)), device=self.device)
        index = torch.as_tensor(index, device=self.device)
        if index.device.type != "cpu":  # reading the values would synchronize
            return torch.where(index < 0, index + len(self), index)
        low, high = (int(index.min()), int(index.max())) if index.numel() else (0, 0)
        if low < -len(self) or high >= len(self):
            raise IndexError(f"There are {len(self)} items, and none at {low} or {high}.")
        return torch.where(index < 0, index + len(self), index) if low < 0 else index

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
