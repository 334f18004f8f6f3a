"""A TorchRL storage for collected steps that keeps each frame once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.utils import expand_right
from torch import Tensor
from torchrl.data import LazyTensorStorage

from torchrl_tit.datasets.storages import Entries, StateCheckpointer, frame_entries, is_peek, nest
from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.choices import Padding
from torchrl_tit.settings.numbers import Batch, Frames
from torchrl_tit.transforms.history import same_observations
from torchrl_tit.windows import Windows, differs, find_windows, take

_STORED = [
    "observation",
    "action",
    *(("next", name) for name in ("observation", "reward", "terminated", "done")),
]
_OPTIONAL = ["action_mask", "is_init", ("next", "truncated"), ("next", "action_mask")]


class OnlineHistoryStorage(LazyTensorStorage):
    """The newest collected steps, as items with histories like those of :class:`HistoryStorage`.

    When it is full, each new step replaces the oldest one. Each observation is stored once. It also
    stores a frame for each end of an episode (its last observation, which the next step does not
    have), one for each environment (its newest next observation), and the K - 1 frames before the
    oldest step. So every item can be drawn, and its histories equal those of
    :class:`~torchrl_tit.transforms.History` in the environment, even if their first steps were
    overwritten. Actions, action masks, rewards and flags are stored unchanged.

    TorchRL keeps the steps without their frames, as in any `LazyTensorStorage`. ``storage[:]`` and
    ``storage[i, j]``, with which slice samplers look for episodes, read that table;
    ``storage.get(...)`` also gathers observations and histories, with any index.

    As in TorchRL's storages, a collector's batches [envs, T] need ``ndim=2``. Pass them to
    ``extend`` as they are; items are numbered by time and environment. An episode ends where a step
    is done, where the next one has "is_init", and where the next step's observation is not this
    step's next observation (because the environment was reset in between). The first step that is
    ever written begins an episode.

    Args:
        max_size: maximum number of steps, rounded up to whole steps of all environments. Memory is
            used as the storage fills up.
        num_frames: number K of observations in a history, at least 1.
        ndim: 1 for the steps of one environment, [T]; 2 for those of several, [envs, T].
        padding: the frames before the first step of an episode: ``"same"`` repeats the first
            observation, ``"constant"`` writes zeros.
        is_init: whether items have "is_init"; see :class:`HistoryStorage`.
        device: device on which the steps are stored.

    Raises:
        ValueError: if a number is less than 1, the padding is unknown, or ``ndim`` is not 1 or 2.

    Example:
        >>> from torchrl.data import ReplayBuffer
        >>> from torchrl.envs import GymEnv
        >>> storage = OnlineHistoryStorage(1000, num_frames=8)
        >>> buffer = ReplayBuffer(storage=storage, batch_size=32)
        >>> _ = buffer.extend(GymEnv("CartPole-v1").rollout(100, break_when_any_done=False))
        >>> buffer.sample()["next", "history"].shape
        torch.Size([32, 8, 4])
    """

    _default_checkpointer = StateCheckpointer
    supports_conditional_update = False

    @checked_arguments
    def __init__(
        self,
        max_size: Batch,
        num_frames: Frames = 1,
        *,
        ndim: int = 1,
        padding: Padding = "same",
        is_init: bool = False,
        device: torch.device | str = "cpu",
    ) -> None:
        if ndim not in (1, 2):
            raise ValueError(f"ndim must be 1 (steps) or 2 (environments, steps), not {ndim}")
        super().__init__(max_size, device=device, ndim=ndim)
        self.max_size: int
        self._num_frames = num_frames
        self._padding: Padding = padding
        self._is_init = is_init
        self._envs = 1
        self._count = 0  # steps per environment so far; a step's time is counted from 0
        self._start = torch.zeros(0)  # the time at which each environment's newest episode began
        # In these tables, the rows of one time are adjacent, one per environment.
        self._items = torch.empty(0)  # int64 [times, envs] or [times]: the row of each step
        self._steps: Entries = {}  # those written so far, as TorchRL stores them
        self._frames = TensorDict()  # at the newest times, K - 1 older ones and the next one
        self._ends = torch.zeros(0)  # per step: the number of its end frame, or -1
        self._end_frames = EndFrames(TensorDict(batch_size=[1]))

    @property
    def num_written(self) -> int:
        """Number of steps written so far, including overwritten ones."""
        return self._count * self._envs

    @property
    def reach(self) -> int:
        """Number of newest steps that items can read: all stored ones and the frames before."""
        return self.max_size + (self._num_frames - 1) * self._envs

    @property
    def oldest(self) -> int:
        """Index of the oldest step, in the first dimension."""
        return self._count % self._num_times if self._count > self._num_times else 0

    @property
    def _num_times(self) -> int:
        """Maximum number of steps per environment."""
        return self.max_size // self._envs

    def __getitem__(self, index: Any) -> TensorDictBase:
        """Gives items; for ``[:]`` and tuples, the table of steps, without their frames."""
        return super().get(index) if is_peek(index) else self.get(index)

    def get(self, index: Any) -> TensorDict:
        """Gathers items with their observations and histories.

        Args:
            index: an index of a tensor of the storage's shape.

        Returns:
            The items, with the shape of the selection.

        Raises:
            IndexError: if there is no such item, or none yet.
        """
        if not self._count:
            raise IndexError("there are no items yet: extend the buffer first")
        item = self._items[: min(self._count, self._num_times)][index]
        entries: Entries = {key: take(table, item) for key, table in self._steps.items()}
        episode, newest = entries["episode"], self._count - 1
        start, env = episode // self._envs, episode % self._envs
        time = newest - (newest - item // self._envs) % self._num_times
        windows = find_windows(time, start, self._num_frames, self._padding)
        windows = Windows(self._frame_row(windows.rows, env.unsqueeze(-1)), windows.missing)
        here, after = self._frame_row(time, env), self._frame_row(time + 1, env)
        end = take(self._ends, item)
        for key, frames in self._frames.items(True, True):
            _, *leaf = (key,) if isinstance(key, str) else key
            following, last = take(frames, after), self._end_frames.table[key]
            following = torch.where(
                expand_right(end < 0, following.shape),
                following,
                take(last, end.clamp(min=0) % len(last)),
            )
            history = windows.gather(frames)
            entries |= frame_entries(tuple(leaf), take(frames, here), history, following, item.ndim)
        if self._is_init:
            entries["next", "is_init"] = entries["is_init"].clone()
        return nest(entries, item.shape)

    def set(self, cursor: Any, data: TensorDictBase, *, set_cursor: bool = True) -> None:
        """Writes steps after the newest ones.

        Args:
            cursor: where TorchRL's `RoundRobinWriter` puts them, which is in order.
            data: steps [T], or [T, envs] if the storage has two dimensions, with "observation"
                (a tensor, or a tensordict of several), "action", and under "next" "observation",
                "reward", "terminated" and "done"; of all other entries, only "truncated" and
                "action_mask" are stored.
            set_cursor: False if items are to be changed, which is not supported.

        Raises:
            RuntimeError: if items are to be changed, or written out of order.
            ValueError: if the steps do not cover all environments, have histories of another entry
                than "observation" or that reach back beyond the first step of an episode, do not
                continue those before them though "is_init" is False, or were made n-step ones by
                TorchRL's `MultiStepTransform`.
        """
        if not set_cursor:
            raise RuntimeError("Stored steps cannot be changed, only added.")
        index = torch.as_tensor(cursor if not isinstance(cursor, range) else list(cursor)).cpu()
        data = data.unsqueeze(0) if index.ndim == 0 else data
        if data.ndim != self.ndim:
            names = "[T]" if self.ndim == 1 else "[envs, T]"
            raise ValueError(
                f"A storage of ndim={self.ndim} takes steps {names}, but these are "
                f"{list(data.shape)} as stored; choose the ndim of the collector's batches."
            )
        _check_histories(data)
        if "steps_to_next_obs" in data.keys():  # noqa: SIM118 (a tensordict)
            raise ValueError(
                'These steps have "steps_to_next_obs": their next observations are n steps away, '
                "so they give no histories. Store single steps, without MultiStepTransform, and "
                "draw slices for n-step targets."
            )
        steps = data.select(*_STORED).update(data.select(*_OPTIONAL, "history", strict=False))
        steps = steps.to(self.device)
        steps = steps if self.ndim == 2 else steps.unsqueeze(-1)  # [T, envs]
        if not self.initialized:
            self._make_room(steps.select("observation")[0])
        if steps.shape[1] != self._envs:
            raise ValueError(
                f"These are steps of {steps.shape[1]} environments, but {self._envs} were stored."
            )
        expected = (self._count + torch.arange(len(steps))) % self._num_times
        if not torch.equal(index.flatten(), expected):
            raise RuntimeError(
                f"The next step has the index {int(expected[0])}, but is to be written at "
                f"{index.flatten()[:1].tolist()}: steps are stored in the order in which they come,"
                " by a RoundRobinWriter, whose state belongs to that of the storage."
            )
        for part in steps.split(self._num_times):
            self._append(part)

    def _append(self, steps: TensorDictBase) -> None:
        """Writes steps [T, envs], at most as many as the storage holds."""
        begin, count = self._count, len(steps)
        frames, following = (group.select("observation") for group in (steps, steps["next"]))
        done = steps["next", "done"].reshape(steps.shape)
        ended = torch.ones_like(done)  # whether it is known that the step before ended its episode
        goes_on = torch.zeros_like(done)  # whether a step continues that episode
        ended[1:], goes_on[1:] = done[:-1], same_observations(following[:-1], frames[1:])
        if begin:
            last, newest = self._newest()
            ended[0], goes_on[0] = self._ends[last] >= 0, same_observations(newest, frames[0])
        if "is_init" in steps.keys():  # noqa: SIM118 (a tensordict)
            is_init = steps["is_init"].reshape(steps.shape)
            if not (ended | goes_on | is_init).all():
                raise ValueError(
                    'These steps do not continue those before them, though "is_init" is False, as '
                    "where batches of several workers follow one another: give each worker a "
                    "storage of its own, or stack them with ndim=2."
                )
            ended |= is_init
        goes_on &= ~ended
        _check_starts(steps, ~goes_on, self._padding)
        if begin:  # only the new steps show whether these ended an episode
            self._end(last, newest, ~goes_on[0])
        time = torch.arange(begin, begin + count, device=self.device).unsqueeze(-1)
        starts = torch.where(goes_on, -1, time)
        starts[0] = torch.where(goes_on[0], self._start, starts[0])
        starts = starts.cummax(0).values
        ends = torch.full_like(starts, -1)
        ended = torch.cat([~goes_on[1:], done[-1:]])
        rows = self._rows(begin, begin + count)
        # The table of ends still has those of the steps that are overwritten.
        self._end_frames.drop(int((self._ends[rows] >= 0).sum()))
        ends[ended] = self._end_frames.push(following[ended]).to(self.device)
        self._ends[rows] = ends.flatten()
        self._frames[self._frame_rows(begin, begin + count + 1)] = torch.cat(
            [frames, following[-1:]]
        ).flatten()
        frames_of = ("observation", "history", ("next", "observation"))
        self._write(begin, steps.exclude(*frames_of, "is_init"), starts)

    def _write(self, begin: int, steps: TensorDictBase, starts: Tensor) -> None:
        """Writes steps [T, envs] without frames into TorchRL's table, and where episodes began."""
        stop = begin + len(steps)
        time = torch.arange(begin, stop, device=self.device).unsqueeze(-1).expand_as(starts)
        steps["episode"] = starts * self._envs + torch.arange(self._envs, device=self.device)
        if self._is_init:
            steps["is_init"] = (time == starts).unsqueeze(-1)
        super().set(
            torch.arange(begin, stop) % self._num_times,
            steps if self.ndim == 2 else steps.squeeze(-1),
        )
        self._count, self._start = stop, starts[-1]
        if len(self._steps.get("episode", ())) < len(self):  # TorchRL shows what is filled
            self._show_steps()

    def _show_steps(self) -> None:
        """Looks up TorchRL's table, whose entries are views of it."""
        table = super().get(slice(None)).flatten(0, self.ndim - 1)
        self._steps = dict(table.items(True, True))

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores a copy, whose views are those of its own table."""
        super().__setstate__(state)
        if self._count:
            self._show_steps()

    def _newest(self) -> tuple[Tensor, TensorDict]:
        """The rows of the newest steps, int64 [envs], and the frames after them."""
        count = self._count
        return self._rows(count - 1, count), self._frames[self._frame_rows(count, count + 1)]

    def _end(self, steps: Tensor, frames: TensorDictBase, ended: Tensor) -> None:
        """Notes that steps, int64 [envs], ended their episodes, unless that is known; bool [envs].

        Args:
            steps: the rows of the steps.
            frames: what followed them, [envs].
            ended: whether they ended an episode.
        """
        ended = ended & (self._ends[steps] < 0)
        self._ends[steps[ended]] = self._end_frames.push(frames[ended]).to(self.device)

    def end_episodes(self) -> None:
        """Ends the episodes of the newest steps: what is written next belongs to others.

        Steps that are not done keep their next observations, from which values are bootstrapped.
        """
        if self._count:
            last, newest = self._newest()
            self._end(last, newest, torch.ones_like(last, dtype=torch.bool))

    def _frame_row(self, time: Tensor, env: Tensor) -> Tensor:
        """Rows of frames, by time and environment; int64 [...]."""
        return time % (self._num_times + self._num_frames) * self._envs + env

    def _rows(self, begin: int, stop: int) -> Tensor:
        """Rows of the steps of some times in the table of ends; int64 [(stop - begin) * envs]."""
        return self._of_all_envs(torch.arange(begin, stop) % self._num_times)

    def _frame_rows(self, begin: int, stop: int) -> Tensor:
        """Rows of the frames of some times."""
        return self._of_all_envs(torch.arange(begin, stop) % (self._num_times + self._num_frames))

    def _of_all_envs(self, times: Tensor) -> Tensor:
        rows = times.unsqueeze(-1) * self._envs + torch.arange(self._envs)
        return rows.flatten().to(self.device)

    def state_dict(self) -> dict[str, Any]:
        """Returns the steps, each frame once."""
        return self.part(0)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Replaces all steps with those returned by `state_dict`."""
        self._empty()
        self.add_part(state_dict)

    def part(self, num_written: int) -> dict[str, Any]:
        """Returns the steps written since an earlier time, to be saved piece by piece.

        The pieces with the newest :attr:`reach` steps restore the storage; older pieces are no
        longer needed.

        Args:
            num_written: :attr:`num_written` at that time.
        """
        stop, since = self._count, num_written // self._envs
        if stop == since:
            return {}
        begin = max(since, stop - self._num_times)
        # The previous piece has the frames before the first step, unless steps since then were
        # overwritten.
        first_frame = begin if begin == since else max(0, begin - self._num_frames + 1)
        # Later steps may have shown whether the newest steps of that time ended an episode.
        first_end = max(0, begin - 1, stop - self._num_times)
        ends = self._ends[self._rows(first_end, stop)]
        first = int(torch.where(ends < 0, self._end_frames.stop, ends).min())
        steps = super().get(torch.arange(begin, stop) % self._num_times).flatten()
        return {
            "begin": begin,
            "stop": stop,
            "max_size": self.max_size,
            "num_frames": self._num_frames,
            "num_envs": self._envs,
            "steps": steps.exclude("episode", "is_init").to_dict(),
            "starts": steps["episode"] // self._envs,
            "first_frame": first_frame,
            "frames": self._frames[self._frame_rows(first_frame, stop + 1)].to_dict(),
            "ends": ends,
            "first_end_frame": first,
            "end_frames": self._end_frames.read(first).to_dict(),
        }

    def add_part(self, part: dict[str, Any]) -> None:
        """Adds a piece that :meth:`part` returned, after the previous pieces.

        Raises:
            ValueError: if a storage of another size saved it, or a previous piece is missing.
        """
        if not part:
            return
        begin, stop, envs = (int(part[name]) for name in ("begin", "stop", "num_envs"))
        frames, steps = _table(part["frames"], self.device), _table(part["steps"], self.device)
        if not self.initialized:
            self._make_room(frames[:envs])
        self._check_part(part)
        self._frames[self._frame_rows(int(part["first_frame"]), stop + 1)] = frames
        self._write(
            begin, steps.reshape(-1, envs), part["starts"].to(self.device).reshape(-1, envs)
        )
        ends = part["ends"].to(self.device)
        self._ends[self._rows(stop - len(ends) // envs, stop)] = ends
        kept, first = self._ends[self._ends >= 0], int(part["first_end_frame"])
        self._end_frames.first = int(kept.min()) if len(kept) else first
        self._end_frames.stop = first  # the part has all later ones
        self._end_frames.push(_table(part["end_frames"], self.device))

    def _check_part(self, part: dict[str, Any]) -> None:
        mine = {"max_size": self.max_size, "num_frames": self._num_frames, "num_envs": self._envs}
        for name, value in mine.items():
            if int(part[name]) != value:
                raise ValueError(
                    f"These steps were saved with {name}={int(part[name])}, but this storage has "
                    f"{name}={value}: load them into one of the same size."
                )
        begin, stop = int(part["begin"]), int(part["stop"])
        if self._count and begin != self._count and stop - begin < self._num_times:
            raise ValueError(
                f"These steps begin at {begin * self._envs}, but {self.num_written} were written: "
                "add all parts, in order."
            )

    def _empty(self) -> None:
        super()._empty()
        self._count = 0
        self._ends.fill_(-1)
        self._end_frames.first = self._end_frames.stop = 0

    def _make_room(self, frames: TensorDictBase) -> None:
        """Allocates the memory of frames, which the system provides as it is written.

        Args:
            frames: the frames of all environments at one time, [envs].
        """
        self._envs = len(frames)
        self.max_size = -(-self.max_size // self._envs) * self._envs
        count = self.max_size + self._num_frames * self._envs
        self._frames = frames.apply(
            lambda x: x.new_empty(count, *x.shape[1:]), batch_size=[count], device=self.device
        )
        self._start = torch.zeros(self._envs, dtype=torch.int64, device=self.device)
        items = torch.arange(self.max_size, device=self.device)
        self._items = items if self.ndim == 1 else items.view(-1, self._envs)
        self._ends = torch.full_like(items, -1)
        self._end_frames = EndFrames(frames.to(self.device))


class EndFrames:
    """A queue of frames, numbered from 0, in a table that grows when it is full.

    Args:
        like: frames [N] that give the shapes and dtypes.

    Example:
        >>> frames = EndFrames(TensorDict({"observation": torch.zeros(1, 2)}, [1]))
        >>> frames.push(TensorDict({"observation": torch.arange(4.0).view(2, 2)}, [2]))
        tensor([0, 1])
        >>> frames.drop(1)
        >>> frames.read(1)["observation"]
        tensor([[2., 3.]])
    """

    def __init__(self, like: TensorDictBase) -> None:
        self.table = like[:1].clone()
        """Frame number n is in row n modulo the length."""
        self.first = 0
        """Number of the oldest frame."""
        self.stop = 0
        """Number of the newest frame, plus one."""

    def push(self, frames: TensorDictBase) -> Tensor:
        """Adds frames [N]; returns their numbers, int64 [N]."""
        stop = self.stop + len(frames)
        if stop - self.first > len(self.table):
            kept, numbers = self.read(self.first), torch.arange(self.first, self.stop)
            self.table = self.table[:1].expand(2 * (stop - self.first)).clone()
            self.table[numbers % len(self.table)] = kept
        numbers = torch.arange(self.stop, stop)
        if len(numbers):
            self.table[numbers % len(self.table)] = frames
        self.stop = stop
        return numbers

    def drop(self, count: int) -> None:
        """Forgets the oldest frames."""
        self.first += count

    def read(self, first: int) -> TensorDict:
        """Copies the frames from number ``first`` on."""
        return self.table[torch.arange(first, self.stop) % len(self.table)]


def _with_histories(steps: TensorDictBase) -> Iterator[tuple[NestedKey, Tensor, Tensor]]:
    """Gives the key, frames [T, ..., *frame] and histories [T, ..., K, *frame] of observations."""
    for key, frames in steps.select("observation").items(True, True):
        history = steps.get(("history", *key[1:]) if isinstance(key, tuple) else "history", None)
        if history is not None:
            yield key, frames, history


def _check_starts(steps: TensorDictBase, begins: Tensor, padding: Padding) -> None:
    """Raises ValueError if histories show steps before those that begin an episode, [T, envs]."""
    for _, frames, history in _with_histories(steps):
        first, older = frames[begins].unsqueeze(1), history[begins][:, :-1]
        pad = first if padding == "same" else torch.zeros_like(first)
        if differs(older, pad.expand_as(older), 1).any():
            raise ValueError(
                f"Histories of steps that begin an episode here do not have padding={padding!r}. "
                "Give the storage History's padding, begin with a reset, let what acts at a reset "
                "(NoopResetEnv) come before History, and give each worker a storage of its own."
            )


def _check_histories(steps: TensorDictBase) -> None:
    """Raises ValueError if histories that will be made again [T, ...] are not of what is stored."""
    for key, frames, history in _with_histories(steps):
        newest = history.select(steps.ndim, -1)
        if newest.shape != frames.shape or differs(newest, frames, steps.ndim).any():
            raise ValueError(
                f"{key!r} is stored, but it is not the newest frame of the histories of these "
                "steps: let the environment write what History stacks under this key"
            )


def _table(entries: dict[str, Any], device: torch.device) -> TensorDict:
    """Makes a tensordict [R] of tensors [R, ...]."""
    table = TensorDict(entries, device=device)
    return table.auto_batch_size_(1)
