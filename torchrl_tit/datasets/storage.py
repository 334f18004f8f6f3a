"""A TorchRL storage that gathers items from episodes when they are drawn."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, NoReturn

import torch
from torch import Tensor

from torchrl_tit.datasets.episodes import Episodes
from torchrl_tit.datasets.errors import DatasetError
from torchrl_tit.datasets.gathering import Entries, GatheringStorage, take


class EpisodeStorage(GatheringStorage):
    """A read-only storage with one item for each step of episodes.

    TorchRL's samplers draw the indices; uniform sampling of indices is uniform over steps.
    Consecutive indices are consecutive steps; the last step of an episode is followed by the next
    episode.

    Args:
        episodes: The data, on the device on which items are gathered.
        counts: Number of steps of each episode, from the first, that are items; int64 [E].

    Raises:
        DatasetError: If no step is left.
    """

    def __init__(self, episodes: Episodes, counts: Tensor) -> None:
        count = int(counts.sum())
        if count == 0:
            raise DatasetError(
                episodes.source,
                f"nothing can be drawn from its {len(episodes.lengths)} episodes: none is "
                f"finished, or all their transitions are left out.",
            )
        super().__init__(count, device=episodes.lengths.device)
        self.initialized, self._len = True, count
        self._total_shape_value = torch.Size([count])
        self._fields = dict(episodes.rows.items())  # [R, ...]
        self._first_rows = episodes.first_rows
        self._ends = counts.cumsum(0)  # [E]: index after the last item of each episode
        self._shifts = episodes.first_rows - (self._ends - counts)  # [E]: row minus index

    def _entries(self, items: Tensor) -> Entries:
        episode = torch.searchsorted(self._ends, items.contiguous(), right=True)
        return self._cut(items + self._shifts[episode], episode)

    @abstractmethod
    def _cut(self, row: Tensor, episode: Tensor) -> Entries:
        """Returns how to gather the items of these rows and episodes, int64 [...] each."""

    def _take(self, name: str, rows: Tensor) -> Tensor:
        """Rows of a field."""
        return take(self._fields[name], rows)

    def set(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuses to write."""
        raise RuntimeError("A data set cannot be written to.")

    def _empty(self) -> NoReturn:
        raise RuntimeError("A data set cannot be emptied.")

    def state_dict(self) -> dict[str, Any]:
        """Returns an identification of the data, which are not part of the state."""
        return {"num_items": len(self)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Checks that a state was saved with the same data.

        Args:
            state_dict: A state that `state_dict` returned.

        Raises:
            ValueError: If it was saved with other data.
        """
        count = int(state_dict["num_items"])
        if count != len(self):
            raise ValueError(
                f"The state was saved with {count} items, but there are {len(self)}; load the same "
                "data with the same settings."
            )
