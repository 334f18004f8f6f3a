"""A TorchRL storage that cuts what a sample needs out of episodes, by index, when it is drawn."""

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
    """Items that start at the steps of episodes, the same number from each step on; read only.

    Any TorchRL sampler draws their indices, and uniform sampling of indices is uniform over steps.

    Args:
        episodes: The data, on the device where items are cut.
        counts: How many steps of each episode, from its first on, are items; int64 [E].

    Raises:
        DatasetError: If no step is left.
    """

    def __init__(self, episodes: Episodes, counts: Tensor) -> None:
        super().__init__(max_size=int(counts.sum()))
        if self.max_size == 0:
            raise DatasetError(
                episodes.source,
                f"nothing can be drawn from its {len(episodes.lengths)} episodes: none ends, or "
                f"the transitions of all are left out.",
            )
        self.device = episodes.lengths.device
        self._fields = dict(episodes.rows.items())  # [R, ...]
        self._first_rows = episodes.first_rows
        self._ends = counts.cumsum(0)  # [E]: the index after each episode's last item
        self._shifts = episodes.first_rows - (self._ends - counts)  # [E]: from index to row

    def get(self, index: int | slice | Sequence[int] | Tensor) -> TensorDict:
        """Cuts items out of the data.

        Args:
            index: Indices of items; negative ones count from the end.

        Returns:
            The items, of the index's shape.

        Raises:
            IndexError: If there is no such item (on a CPU; elsewhere that is not checked).
        """
        index = self._as_tensor(index)
        episode = torch.searchsorted(self._ends, index, right=True)
        return self._cut(index + self._shifts[episode], episode)

    @abstractmethod
    def _cut(self, row: Tensor, episode: Tensor) -> TensorDict:
        """The items whose steps stand in these rows and episodes, [...] each."""

    def _take(self, name: str, rows: Tensor) -> Tensor:
        """Rows of a field; index_select is several times as fast as indexing."""
        field = self._fields[name]
        return field.index_select(0, rows.flatten()).view(*rows.shape, *field.shape[1:])

    def _as_tensor(self, index: Any) -> Tensor:
        if isinstance(index, slice):
            return torch.arange(*index.indices(len(self)), device=self.device)
        index = torch.as_tensor(index, device=self.device)
        if index.device.type != "cpu":  # where looking at the values would wait for the device
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
        """What tells whether a saved state belongs to these data, which are not part of it."""
        return {"num_items": len(self)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Checks that a state was saved over these data.

        Args:
            state_dict: What `state_dict` returned.

        Raises:
            ValueError: If it was saved over others.
        """
        if state_dict["num_items"] != len(self):
            raise ValueError(
                f"The state was saved over {state_dict['num_items']} items, but there are "
                f"{len(self)}; load the same data with the same settings."
            )
