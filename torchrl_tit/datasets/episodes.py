"""Episodes, stored one after the other, each with its final observation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tit.datasets.errors import DatasetError

CHUNK_BYTES = 4 * 2**20  # bytes read, checked and converted at a time


@dataclass(frozen=True, eq=False)
class Episodes:
    """A data set as a flat stream of rows: an episode of T steps is T + 1 rows.

    Row t of an episode is its step t: the observation, the action taken, and the reward and flags
    that followed. Its last row is the final observation, with zeros in the other fields. So each
    observation is stored once, and the next observation of a row is that of the following row.

    Args:
        rows: [R] with "observation" [R, *obs], "action" [R, *action], and "reward", "terminated"
            and "truncated" [R, 1].
        lengths: Number of steps of each episode; int64 [E], all at least 1.
        final_known: Whether the final observation of each episode is known (otherwise it is zeros);
            bool [E].
        source: Name of the source, for error messages.
        attributes: The source's metadata, as strings and numbers.
        left_out: Names of the source's fields that were not read.

    Example:
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> episodes = episodes_from_arrays(
        ...     observations=np.arange(5.0).reshape(5, 1),
        ...     actions=np.zeros((5, 1)),
        ...     rewards=np.ones(5),
        ...     terminals=np.array([False, False, True, False, True]),
        ... )
        >>> episodes.lengths, episodes.returns
        (tensor([3, 2]), tensor([3., 2.], dtype=torch.float64))
        >>> episodes.rows["observation"].flatten()
        tensor([0., 1., 2., 0., 3., 4., 0.])
    """

    rows: TensorDictBase
    lengths: Tensor
    final_known: Tensor
    source: str = "the data"
    attributes: Mapping[str, Any] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()

    @property
    def num_transitions(self) -> int:
        """Number of steps of all episodes."""
        return int(self.lengths.sum())

    @property
    def first_rows(self) -> Tensor:
        """Row of each episode's first step; int64 [E]."""
        return (self.lengths + 1).cumsum(0) - self.lengths - 1

    @property
    def last_rows(self) -> Tensor:
        """Row of each episode's last step; int64 [E]."""
        return (self.lengths + 1).cumsum(0) - 2

    @property
    def step_rows(self) -> Tensor:
        """Row of each step, in order: all rows but those of final observations; int64 [N]."""
        shifts = torch.arange(len(self.lengths), device=self.lengths.device)
        steps = torch.arange(self.num_transitions, device=self.lengths.device)
        return steps + shifts.repeat_interleave(self.lengths)

    @property
    def terminated(self) -> Tensor:
        """Whether each episode ended in a terminal state; bool [E]."""
        return self.rows["terminated"][self.last_rows].squeeze(-1)

    @property
    def truncated(self) -> Tensor:
        """Whether each episode was truncated, by a time limit for example; bool [E]."""
        return self.rows["truncated"][self.last_rows].squeeze(-1)

    @property
    def returns(self) -> Tensor:
        """Undiscounted return of each episode; float64 [E]."""
        rewards = self.rows["reward"].squeeze(-1).cpu().double().numpy()
        return torch.from_numpy(np.add.reduceat(rewards, self.first_rows.cpu().numpy()))

    @property
    def finished(self) -> Tensor:
        """Whether each episode was terminated or truncated; bool [E]."""
        return self.terminated | self.truncated

    def to(self, device: torch.device | str) -> Episodes:
        """Copies the data to a device; windows are then gathered there.

        Args:
            device: The device, such as "cuda".

        Returns:
            The same episodes on the device.
        """
        return replace(
            self,
            rows=self.rows.to(device),
            lengths=self.lengths.to(device),
            final_known=self.final_known.to(device),
        )

    def observation_statistics(self) -> tuple[Tensor, Tensor]:
        """Computes the mean and standard deviation of the observations of finished episodes.

        Returns:
            Mean and population standard deviation, float32 [*obs] each, for
            :meth:`torchrl_tit.frames.NormalizedFrames.set_statistics`.
        """
        count = self.lengths[self.finished].sum()
        mean = sum(chunk.double().sum(0) for chunk in self._observations()) / count
        squares = sum(chunk.double().sub_(mean).square_().sum(0) for chunk in self._observations())
        return mean.float(), (squares / count).sqrt().float()

    def _observations(self) -> Iterator[Tensor]:
        """The observations at the steps of finished episodes, in chunks."""
        chosen = self.finished.repeat_interleave(self.lengths + 1)  # [R]
        chosen[self.last_rows + 1] = False  # final observations are not steps
        observations = self.rows["observation"]
        size = rows_per_chunk(observations[0].numel() * 8)  # as float64
        for start in range(0, len(observations), size):
            yield observations[start : start + size][chosen[start : start + size]]


def check_final_observations(episodes: Episodes) -> None:
    """Checks that the episodes can be written with their final observations.

    Args:
        episodes: The data.

    Raises:
        DatasetError: If the final observation of a truncated episode is unknown.

    Example:
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> states = np.zeros((2, 3))
        >>> episodes = episodes_from_arrays(states, states, np.ones(2), [0, 0], [0, 1])
        >>> check_final_observations(episodes)
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.errors.DatasetError: the data: episode 0 was truncated and its...
    """
    unknown = ~episodes.final_known & ~episodes.terminated
    if unknown.any():
        raise DatasetError(
            episodes.source,
            f"episode {int(unknown.int().argmax())} was truncated and its final observation is "
            f"unknown, because there are no 'next_observations': it cannot be written.",
        )


def rows_per_chunk(bytes_per_row: int) -> int:
    """Returns the number of rows to process at a time, at least 1.

    Args:
        bytes_per_row: Size of one row.

    Example:
        >>> rows_per_chunk(1024)
        4096
    """
    return max(1, CHUNK_BYTES // max(1, bytes_per_row))
