"""Episodes that Online Decision Transformer trains on: first a data set, then its own."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from tensordict import TensorDict, TensorDictBase
from torchrl.data import ReplayBuffer

from torchrl_tit.datasets import (
    Episodes,
    SequenceStorage,
    join_episodes,
    make_replay_buffer,
    select_episodes,
)

_LIMIT = 1 - 1e-6
"""The largest action to which a squashed Gaussian assigns a finite likelihood."""


class OnlineData:
    """Draws batches from a data set; after the first rollout, from a first-in first-out store.

    The store initially holds the best episodes of the data set. Each added episode replaces the
    oldest one; those of the data set are replaced first, from the worst to the best.

    Args:
        episodes: the data set.
        make_storage: cuts windows out of episodes.
        batch_size: windows in a batch.
        capacity: number of episodes in the store.
        seed: seed for sampling.
    """

    def __init__(
        self,
        episodes: Episodes,
        make_storage: Callable[[Episodes], SequenceStorage],
        *,
        batch_size: int,
        capacity: int,
        seed: int,
    ) -> None:
        self.rounds = 0
        """Number of times that episodes were added."""
        self.newest_return = math.nan
        """Mean return of the episodes added last; NaN before the first."""
        self._episodes = episodes
        self._make_storage = make_storage
        self._batch_size = batch_size
        self._capacity = capacity
        self._seed = seed
        self._buffer = self._make_buffer()

    def sample(self) -> TensorDictBase:
        """Draws a batch, with actions clipped to those that a squashed Gaussian can produce."""
        batch = self._buffer.sample()
        batch["action"].clamp_(-_LIMIT, _LIMIT)
        return batch

    def add(self, episodes: Episodes) -> None:
        """Adds episodes to the store."""
        if self.rounds == 0:
            finished = self._episodes.finished.nonzero().squeeze(-1)
            order = self._episodes.returns[finished.cpu()].argsort(stable=True)
            best = finished[order.to(finished.device)][-self._capacity :]
            self._episodes = select_episodes(self._episodes, best)
        joined = join_episodes([self._episodes, episodes])
        oldest = max(0, len(joined.lengths) - self._capacity)
        index = joined.lengths.new_tensor(range(oldest, len(joined.lengths)))
        self._episodes = select_episodes(joined, index)
        self.rounds += 1
        self.newest_return = episodes.returns.mean().item()
        self._buffer = self._make_buffer()

    def state_dict(self) -> dict[str, Any]:
        """Returns the episodes of the store, without the data set, and the sampling state."""
        state: dict[str, Any] = {"rounds": self.rounds, "buffer": self._buffer.state_dict()}
        if self.rounds:
            state["newest_return"] = self.newest_return
            state["rows"] = dict(self._episodes.rows.items())
            state["lengths"] = self._episodes.lengths
            state["final_known"] = self._episodes.final_known
        return state

    def load_state_dict(self, state_dict: dict[str, Any], /) -> None:
        """Restores a state."""
        self.rounds = state_dict["rounds"]
        if self.rounds:
            self.newest_return = state_dict["newest_return"]
            rows = TensorDict(state_dict["rows"])
            rows.auto_batch_size_(1)
            self._episodes = Episodes(
                rows=rows,
                lengths=state_dict["lengths"],
                final_known=state_dict["final_known"],
                source=self._episodes.source,
            ).to(self._episodes.lengths.device)
            self._buffer = self._make_buffer()
        self._buffer.load_state_dict(state_dict["buffer"])

    def _make_buffer(self) -> ReplayBuffer:
        seed = np.random.SeedSequence([self._seed, self.rounds]).generate_state(1).item()
        return make_replay_buffer(self._make_storage(self._episodes), self._batch_size, seed=seed)
