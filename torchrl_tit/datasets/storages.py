"""Replay-buffer storages of data sets: items are cut out of episodes when they are drawn."""

from __future__ import annotations

import hashlib
import os
from abc import abstractmethod
from functools import cached_property
from typing import Any, Literal, NoReturn

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.utils import expand_right
from torch import Tensor
from torchrl.data import TensorStorage
from torchrl.data.replay_buffers.checkpointers import StorageCheckpointerBase

from torchrl_tit.datasets.checks import DatasetError
from torchrl_tit.datasets.episodes import Episodes, Unfinished
from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.choices import Padding
from torchrl_tit.settings.numbers import Frames, Positive, Real
from torchrl_tit.windows import find_windows, take

Entries = dict[NestedKey, Tensor]
TimeLimits = Literal["keep", "drop"]
TerminalObservations = Literal["keep", "zero"]


class StateCheckpointer(StorageCheckpointerBase):
    """Writes the state of a storage, for ``ReplayBuffer.dumps``."""

    def dumps(self, storage: TensorStorage, path: str | os.PathLike[str]) -> None:
        """Writes the state into a folder."""
        TensorDict(storage.state_dict(), []).memmap(path, copy_existing=True)

    def loads(self, storage: TensorStorage, path: str | os.PathLike[str]) -> None:
        """Loads the state."""
        storage.load_state_dict(TensorDict.load_memmap(path).to_dict())


class EpisodeStorage(TensorStorage):
    """A read-only storage with one item for each step of episodes.

    TorchRL's samplers draw the indices; uniform sampling of indices is uniform over steps.
    Consecutive indices are consecutive steps; the last step of an episode is followed by the next
    episode. To TorchRL this is a table of the row of each item, 8 bytes each, which it indexes
    as any tensor.

    Args:
        episodes: the data, on the device on which items are gathered.
        counts: number of steps of each episode, from the first, that are items; int64 [E].

    Raises:
        DatasetError: if no step is left.
    """

    # A replay buffer replaces a checkpointer that was set, and knows the usual one by this name.
    _default_checkpointer = StateCheckpointer
    supports_conditional_update = False
    oldest = 0
    """Index of the oldest item."""

    def __init__(self, episodes: Episodes, counts: Tensor) -> None:
        count = int(counts.sum())
        if count == 0:
            raise DatasetError(
                episodes.source,
                f"nothing can be drawn from its {len(episodes.lengths)} episodes: none is "
                f"finished, or all their transitions are left out.",
            )
        device = episodes.lengths.device
        shifts = episodes.first_rows - (counts.cumsum(0) - counts)
        rows = torch.arange(count, device=device) + shifts.repeat_interleave(counts)
        super().__init__(rows, device=device)
        self.num_episodes = int(counts.count_nonzero())
        """Number of episodes that have items."""
        self._fields = dict(episodes.rows.items())  # [R, ...]
        self._first_rows = episodes.first_rows

    def get(self, index: Any) -> TensorDict:
        """Cuts items out of the episodes.

        Args:
            index: an index of a tensor [N].

        Returns:
            The items, with the shape of the selection.

        Raises:
            IndexError: if there is no such item.
        """
        return nest(*self._cut(*self._find(index)))

    def _find(self, index: Any) -> tuple[Tensor, Tensor]:
        """The rows and the episodes of items, int64 [...] each."""
        row = super().get(index).contiguous()
        return row, torch.searchsorted(self._first_rows, row, right=True) - 1

    @abstractmethod
    def _cut(self, row: Tensor, episode: Tensor) -> tuple[Entries, torch.Size]:
        """Returns the entries of the items of some rows and episodes, and their shape."""

    def set(self, *args: Any, **kwargs: Any) -> NoReturn:
        """Refuses to write."""
        raise RuntimeError("A data set cannot be written to.")

    def _empty(self) -> NoReturn:
        raise RuntimeError("A data set cannot be emptied.")

    def state_dict(self) -> dict[str, Any]:
        """Returns an identification of the data, which are not part of the state."""
        return {"num_items": len(self), "digest": self._digest}

    @cached_property
    def _digest(self) -> int:
        """A checksum of evenly spaced rows: of all, it would read data larger than the memory."""
        found = hashlib.sha256()
        for field in self._fields.values():
            found.update(field[:: 1 + len(field) // 1000].cpu().numpy().tobytes())
        return int.from_bytes(found.digest()[:7])

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Checks that a state was saved with the same data.

        Args:
            state_dict: a state that `state_dict` returned.

        Raises:
            ValueError: if it was saved with other data.
        """
        count = int(state_dict["num_items"])
        if count != len(self):
            raise ValueError(
                f"The state was saved with {count} items, but there are {len(self)}; load the same "
                "data with the same settings."
            )
        if int(state_dict.get("digest", self._digest)) != self._digest:
            raise ValueError(
                "The state was saved with other data, of which there were as many; load the same."
            )


class HistoryStorage(EpisodeStorage):
    """Transitions with the histories of the observation and of the next observation.

    An item has "observation" [*obs], "history" [K, *obs], "action" (int64 if it is discrete), and
    under "next" "observation", "history", "reward" [1], "terminated" [1], "truncated" [1] and
    "done" [1], like the steps of an environment with :class:`~torchrl_tit.transforms.History`. A
    history never contains observations of another episode. "episode", int64, is the number of the
    item's episode, as TorchRL's `SliceSampler` expects it.

    ``storage[:]`` and ``storage[i, j]`` are what slice samplers ask for to find episodes: they give
    all entries but observations and histories, which could take many times the memory of the data.
    ``storage.get(...)`` gathers these too, with any index.

    Args:
        episodes: the data.
        num_frames: number K of observations in a history, at least 1.
        padding: the frames before the first step of an episode: ``"same"`` repeats the first
            observation, ``"constant"`` writes zeros.
        time_limits: ``"drop"`` leaves out the last transition of truncated episodes, as d3rlpy 1
            does. It is always left out if the next observation is unknown.
        terminal_observations: ``"zero"`` replaces the observations of terminal states with zeros,
            as d3rlpy 1 does. They are always zeros if unknown.
        unfinished: ``"drop"`` leaves out an episode that is neither terminated nor truncated
            because the data end there. If such an episode is kept, no flag marks its end.
        is_init: whether items have "is_init" and ("next", "is_init") [1], True at the first step of
            an episode. In slices of consecutive items, a :class:`~torchrl_tit.modules.Backbone`
            then encodes each frame once.

    Raises:
        ValueError: if a setting is not one of the above.
        DatasetError: if no transition is left.

    Source: "Transformer in Transformer as Backbone for Deep Reinforcement Learning" (arXiv
    2212.14538), section 3; d3rlpy 1.1.1 for the two settings.

    Example:
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> states, ends = torch.arange(1.0, 5.0).view(4, 1), [False, False, False, True]
        >>> episodes = episodes_from_arrays(states, states, states, ends)
        >>> storage = HistoryStorage(episodes, num_frames=3)
        >>> storage[1]["history"].flatten(), storage[1]["next", "history"].flatten()
        (tensor([1., 1., 2.]), tensor([1., 2., 3.]))
    """

    @checked_arguments
    def __init__(
        self,
        episodes: Episodes,
        num_frames: Frames = 1,
        *,
        padding: Padding = "same",
        time_limits: TimeLimits = "keep",
        terminal_observations: TerminalObservations = "keep",
        unfinished: Unfinished = "drop",
        is_init: bool = False,
    ) -> None:
        if not isinstance(episodes, Episodes):
            raise ValueError(f"episodes must be Episodes, as of load_episodes, not {episodes!r}")
        left_out = ~episodes.final_known
        if time_limits == "drop":
            left_out = left_out | episodes.truncated
        counts = episodes.lengths - (left_out & ~episodes.terminated).long()
        if unfinished == "drop":
            counts = counts * episodes.finished
        super().__init__(episodes, counts)
        self._num_frames = num_frames
        self._padding: Padding = padding
        self._zero_terminals = terminal_observations == "zero"
        self._is_init = is_init

    def __getitem__(self, index: Any) -> TensorDictBase:
        """Gives items; for ``[:]`` and tuples, without observations and histories."""
        return self._steps[index] if is_peek(index) else self.get(index)

    @cached_property
    def _steps(self) -> TensorDict:
        """All items without observations and histories, once a sampler asks for them."""
        row, episode = self._find(slice(None))
        return nest(self._outcome(row, episode), row.shape)

    def _outcome(self, row: Tensor, episode: Tensor) -> Entries:
        """The entries of items that are no frames."""
        names = ("action", "reward", "terminated", "truncated")
        action, reward, terminated, truncated = (take(self._fields[name], row) for name in names)
        entries: Entries = {
            # Losses use discrete actions as indices.
            "action": action if action.is_floating_point() else action.long(),
            ("next", "reward"): reward,
            ("next", "terminated"): terminated,
            ("next", "truncated"): truncated,
            ("next", "done"): terminated | truncated,
            "episode": episode,
        }
        if self._is_init:
            starts = (row == self._first_rows[episode]).unsqueeze(-1)
            entries |= {"is_init": starts, ("next", "is_init"): starts.clone()}
        return entries

    def _cut(self, row: Tensor, episode: Tensor) -> tuple[Entries, torch.Size]:
        entries, frames = self._outcome(row, episode), self._fields["observation"]
        following = take(frames, row + 1)
        if self._zero_terminals:
            terminated = entries["next", "terminated"].squeeze(-1)
            following.masked_fill_(expand_right(terminated, following.shape), 0)
        windows = find_windows(row, self._first_rows[episode], self._num_frames, self._padding)
        entries |= frame_entries((), take(frames, row), windows.gather(frames), following, row.ndim)
        return entries, row.shape


class SequenceStorage(EpisodeStorage):
    """Windows of up to K steps that start at any step of a whole episode, padded on the left.

    An item has "observation" [K, *obs], "action" [K, *action] (int64 if it is discrete),
    "return_to_go" [K, 1], "timestep" int64 [K] and "mask" bool [K], which is False at padding.
    A uniformly drawn index selects an episode with a probability proportional to its length, and
    without ``full`` a uniformly distributed start within it. Unfinished episodes and parts of
    others are left out, because the rest of their returns is not known.

    Args:
        episodes: the data.
        num_frames: number K of steps, at least 1.
        return_scale: divisor of the returns-to-go.
        action_padding: value of the actions at padding, where all other entries are 0.
        full: whether windows that would pass their episode's end begin earlier, so that only those
            of episodes shorter than K are padded.

    Raises:
        ValueError: if ``num_frames`` is less than 1, or ``return_scale`` is not positive.
        DatasetError: if no episode is whole.

    Source: "Decision Transformer" (arXiv 2106.01345), section 3 and its authors' code: that of
    MuJoCo, or with ``full`` that of Atari.

    Example:
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> ends = np.array([False, True, False, True])
        >>> episodes = episodes_from_arrays(np.ones((4, 2)), np.ones((4, 1)), np.arange(4), ends)
        >>> item = SequenceStorage(episodes, num_frames=3, return_scale=1.0)[2]
        >>> item["mask"], item["return_to_go"].flatten()
        (tensor([False,  True,  True]), tensor([0., 5., 3.]))
    """

    @checked_arguments
    def __init__(
        self,
        episodes: Episodes,
        num_frames: Frames = 20,
        *,
        return_scale: Positive = 1000.0,
        action_padding: Real = -10.0,
        full: bool = False,
    ) -> None:
        super().__init__(episodes, episodes.lengths * episodes.is_whole)
        self._full = full
        self._last_rows = episodes.last_rows
        self._returns_to_go = _returns_to_go(episodes).div_(return_scale).float()  # [R]
        self._action_padding = action_padding
        self._num_frames = num_frames

    def _cut(self, row: Tensor, episode: Tensor) -> tuple[Entries, torch.Size]:
        shape, row, episode = row.shape, row.unsqueeze(-1), episode.unsqueeze(-1)
        if self._full:
            last_full = self._last_rows[episode] - self._num_frames + 1
            row = torch.minimum(row, last_full.clamp(min=self._first_rows[episode]))
        length = (self._last_rows[episode] - row + 1).clamp(max=self._num_frames)  # [..., 1]
        # [..., K]: below 0 at padding
        step = torch.arange(self._num_frames, device=self.device) - self._num_frames + length
        padding, rows = step < 0, row + step.clamp(min=0)

        def fill(values: Tensor, value: float = 0) -> Tensor:
            return values.masked_fill(expand_right(padding, values.shape), value)

        action = take(self._fields["action"], rows)  # [..., K, *action]
        if not action.is_floating_point():
            action = action.long()  # padding is negative
        entries: Entries = {
            "observation": fill(take(self._fields["observation"], rows)),
            "action": fill(action, self._action_padding),
            "return_to_go": fill(self._returns_to_go[rows]).unsqueeze(-1),
            "timestep": fill(rows - self._first_rows[episode]),
            "mask": ~padding,
        }
        return entries, shape


def _returns_to_go(episodes: Episodes) -> Tensor:
    """Sum of the rewards from each row to its episode's end; float64 [R]."""
    rewards = episodes.rows["reward"].squeeze(-1).cpu().double().numpy()
    total = np.cumsum(rewards[::-1])[::-1]
    # The row of an episode's final observation has no reward; the sum there is that of later
    # episodes.
    later = torch.from_numpy(total.copy()).to(episodes.lengths.device)
    after = later[episodes.last_rows + 1]
    return later - after.repeat_interleave(episodes.lengths + 1)


def is_peek(index: Any) -> bool:
    """Whether an index is one with which slice samplers look for episodes: ``[:]`` or a tuple."""
    return isinstance(index, tuple) or (isinstance(index, slice) and index == slice(None))


def frame_entries(
    leaf: tuple[str, ...], newest: Tensor, history: Tensor, following: Tensor, ndim: int
) -> Entries:
    """Returns the entries of observations and histories, none a view of another.

    Args:
        leaf: the rest of the keys after "observation" and "history": empty, or the name of one of
            several observations.
        newest: the observations, [..., *obs].
        history: the histories, [..., K, *obs].
        following: the next observations, [..., *obs].
        ndim: number of leading dimensions.
    """
    kept = history.narrow(ndim, 1, history.shape[ndim] - 1)
    return {
        ("observation", *leaf): newest,
        ("history", *leaf): history,
        ("next", "observation", *leaf): following,
        ("next", "history", *leaf): torch.cat([kept, following.unsqueeze(ndim)], ndim),
    }


def nest(entries: Entries, shape: torch.Size) -> TensorDict:
    """Makes a tensordict; faster than setting nested keys one by one."""
    nested: dict[str, Any] = {}
    for key, value in entries.items():
        *groups, name = (key,) if isinstance(key, str) else key
        group = nested
        for each in groups:
            group = group.setdefault(each, {})
        group[name] = value
    return TensorDict(nested, shape)
