"""A TorchRL storage for collected steps that keeps each frame once."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_tit.datasets.end_frames import EndFrames
from torchrl_tit.datasets.gathering import Entries, GatheringStorage, take
from torchrl_tit.datasets.histories import check_windows, episode_entries, frame_entries
from torchrl_tit.settings.arguments import checked_arguments
from torchrl_tit.settings.numbers import Batch
from torchrl_tit.windows import Padding, Windows, find_windows

_HERE = ("observation", "action", "action_mask", "is_init")
_NEXT = ("observation", "reward", "terminated", "truncated", "done", "action_mask")
_OPTIONAL = ("action_mask", "is_init", "truncated")


class OnlineHistoryStorage(GatheringStorage):
    """The newest collected steps, as items with histories like those of :class:`HistoryStorage`.

    When it is full, each new step replaces the oldest one. Each observation is stored once. It also
    stores a frame for each end of an episode (its last observation, which the next step does not
    have), one for each environment (its newest next observation), and the K - 1 frames before the
    oldest step. So every item can be drawn, and its histories equal those of
    :class:`~torchrl_tit.transforms.History` in the environment, even if their first steps were
    overwritten. Actions, action masks, rewards and flags are stored unchanged.

    As in TorchRL's storages, a collector's batches [envs, T] need ``ndim=2``. Pass them to
    ``extend`` as they are; items are numbered by time and environment. An episode ends where a step
    is done, where the next one has "is_init", and where the next step's observation is not this
    step's next observation (because the environment was reset in between). The first step that is
    ever written begins an episode.

    Args:
        max_size: Maximum number of steps, rounded up to whole steps of all environments. Memory is
            used as the storage fills up.
        num_frames: Number K of observations in a history, at least 1.
        ndim: 1 for the steps of one environment, [T]; 2 for those of several, [envs, T].
        padding: The frames before the first step of an episode: ``"same"`` repeats the first
            observation, ``"constant"`` writes zeros.
        is_init: Whether items have "is_init"; see :class:`HistoryStorage`.
        device: Device on which the steps are stored.

    Raises:
        TypeError: If ``num_frames`` is not an integer.
        ValueError: If a number is less than 1, the padding is unknown, or ``ndim`` is not 1 or 2.

    Example:
        >>> from torchrl.data import ReplayBuffer
        >>> from torchrl.envs import GymEnv
        >>> storage = OnlineHistoryStorage(1000, num_frames=8)
        >>> buffer = ReplayBuffer(storage=storage, batch_size=32)
        >>> _ = buffer.extend(GymEnv("CartPole-v1").rollout(100, break_when_any_done=False))
        >>> buffer.sample()["next", "history"].shape
        torch.Size([32, 8, 4])
    """

    @checked_arguments
    def __init__(
        self,
        max_size: Batch,
        num_frames: int = 1,
        *,
        ndim: int = 1,
        padding: Padding = "same",
        is_init: bool = False,
        device: torch.device | str = "cpu",
    ) -> None:
        check_windows(num_frames, padding)
        if ndim not in (1, 2):
            raise ValueError(f"ndim must be 1 (steps) or 2 (environments, steps), not {ndim}")
        super().__init__(max_size, device=device, ndim=ndim)
        self.max_size: int
        self._num_frames = num_frames
        self._padding: Padding = padding if num_frames > 1 else "same"
        self._is_init = is_init
        self._envs = 1
        self._count = 0  # steps per environment so far; a step's time is counted from 0
        # In these tables, the rows of one time are adjacent, one per environment.
        self._steps = TensorDict()  # action and outcome at the newest times
        self._frames = TensorDict()  # at the same times, K - 1 older ones and the next one
        self._starts = torch.empty(0)  # per step: the time at which its episode begins
        self._ends = torch.empty(0)  # per step: the number of its end frame, or -1
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
    def num_end_frames(self) -> int:
        """Number of frames that are stored because an episode ended."""
        return self._end_frames.stop - self._end_frames.first

    def set(self, cursor: Any, data: TensorDictBase, *, set_cursor: bool = True) -> None:
        """Writes steps after the newest ones.

        Args:
            cursor: Where TorchRL's `RoundRobinWriter` puts them, which is in order.
            data: Steps [T], or [T, envs] if the storage has two dimensions, with "observation"
                (a tensor, or a tensordict of several), "action", and under "next" "observation",
                "reward", "terminated" and "done"; of all other entries, only "truncated" and
                "action_mask" are stored.
            set_cursor: False if items are to be changed, which is not supported.

        Raises:
            RuntimeError: If items are to be changed, or written out of order.
            ValueError: If the steps do not cover all environments.
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
        steps = _select(data).to(self.device)
        steps = steps if self.ndim == 2 else steps.unsqueeze(-1)  # [T, envs]
        if not self.initialized:
            self._make_room(steps.select("observation")[0], _fields_of(steps)[0])
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
        self._finish()

    def _append(self, data: TensorDictBase) -> None:
        """Writes steps [T, envs], at most as many as the storage holds."""
        begin, count, envs = self._count, len(data), self._envs
        frames, following = (group.select("observation") for group in (data, data["next"]))
        done = _flag(data, "done")
        goes_on = torch.zeros(count, envs, dtype=torch.bool, device=self.device)
        goes_on[1:] = ~done[:-1] & _equal(following[:-1], frames[1:])
        last = self._rows(begin - 1, begin)  # the newest steps so far
        if begin:
            newest = self._frames[self._frame_rows(begin, begin + 1)]
            same = (self._ends[last] < 0) & ~_flag(self._steps[last], "done")
            goes_on[0] = same & _equal(newest, frames[0])
        if (is_init := data.get("is_init", None)) is not None:
            goes_on &= ~is_init.reshape(count, envs)
        if begin:  # only the new steps show whether these ended an episode
            ended = ~goes_on[0] & (self._ends[last] < 0)
            self._ends[last[ended]] = self._push(newest[ended])
        starts = torch.arange(begin, begin + count, device=self.device).unsqueeze(-1)
        starts = torch.where(goes_on, -1, starts)
        if begin:
            starts[0] = starts[0].maximum(self._starts[last])
        ends = torch.full_like(starts, -1)
        ended = torch.cat([~goes_on[1:], done[-1:]])
        rows = self._rows(begin, begin + count)
        self._end_frames.drop(int((self._ends[rows] >= 0).sum()))  # of the overwritten steps
        ends[ended] = self._push(following[ended])
        self._starts[rows] = starts.cummax(0).values.flatten()
        self._ends[rows] = ends.flatten()
        self._steps[rows] = _fields_of(data).flatten()
        self._frames[self._frame_rows(begin, begin + count + 1)] = torch.cat(
            [frames, following[-1:]]
        ).flatten()
        self._count += count

    def end_episodes(self) -> None:
        """Ends the episodes of the newest steps: what is written next belongs to others.

        Steps that are not done keep their next observations, from which values are bootstrapped.
        """
        if not self._count:
            return
        last = self._rows(self._count - 1, self._count)
        going = self._ends[last] < 0
        newest = self._frames[self._frame_rows(self._count, self._count + 1)]
        self._ends[last[going]] = self._push(newest[going])

    def _push(self, frames: TensorDictBase) -> Tensor:
        return self._end_frames.push(frames).to(self.device)

    def _entries(self, items: Tensor) -> Entries:
        env = items % self._envs
        newest = self._count - 1
        time = newest - (newest - items // self._envs) % self._num_times
        start = take(self._starts, items)
        end = cache(partial(take, self._ends, items))
        first_of_episode = (time == start) if self._is_init else None
        entries = episode_entries(start * self._envs + env, first_of_episode)

        @cache
        def windows() -> Windows:
            found = find_windows(time, start, self._num_frames, self._padding)
            return Windows(self._row(found.rows, env.unsqueeze(-1)), found.missing)

        def following(table: Tensor, last: Tensor) -> Tensor:
            frames = take(table, self._row(time + 1, env))
            here = (end() < 0).view(*items.shape, *[1] * (frames.ndim - items.ndim))
            return torch.where(here, frames, take(last, end().clamp(min=0) % len(last)))

        def history(table: Tensor) -> Tensor:
            return windows().gather(table)

        for key, table in self._frames.items(True, True):
            _, *leaf = (key,) if isinstance(key, str) else key
            last = self._end_frames.table[key]
            entries |= frame_entries(
                tuple(leaf),
                partial(_take_later, table, lambda: self._row(time, env)),
                partial(history, table),
                partial(following, table, last),
                items.ndim,
            )
        for key, table in self._steps.items(True, True):
            entries[key] = partial(take, table, items)
        return entries

    def _row(self, time: Tensor, env: Tensor) -> Tensor:
        """Rows of frames, by time and environment; int64 [...]."""
        return time % (self._num_times + self._num_frames) * self._envs + env

    def _rows(self, begin: int, stop: int) -> Tensor:
        """Rows of the steps of some times, int64 [(stop - begin) * envs]."""
        return self._of_all_envs(torch.arange(begin, stop) % self._num_times)

    def _frame_rows(self, begin: int, stop: int) -> Tensor:
        """Rows of the frames of some times."""
        return self._of_all_envs(torch.arange(begin, stop) % (self._num_times + self._num_frames))

    def _of_all_envs(self, times: Tensor) -> Tensor:
        rows = times.unsqueeze(-1) * self._envs + torch.arange(self._envs)
        return rows.flatten().to(self.device)

    @property
    def _num_times(self) -> int:
        """Maximum number of steps per environment."""
        return self.max_size // self._envs

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
        return {
            "begin": begin,
            "stop": stop,
            "max_size": self.max_size,
            "num_frames": self._num_frames,
            "num_envs": self._envs,
            "steps": self._steps[self._rows(begin, stop)].to_dict(),
            "starts": self._starts[self._rows(begin, stop)],
            "first_frame": first_frame,
            "frames": self._frames[self._frame_rows(first_frame, stop + 1)].to_dict(),
            "ends": ends,
            "first_end_frame": first,
            "end_frames": self._end_frames.read(first).to_dict(),
        }

    def add_part(self, part: dict[str, Any]) -> None:
        """Adds a piece that :meth:`part` returned, after the previous pieces.

        Raises:
            ValueError: If a storage of another size saved it, or a previous piece is missing.
        """
        if not part:
            return
        begin, stop, envs = (int(part[name]) for name in ("begin", "stop", "num_envs"))
        frames, steps = _table(part["frames"], self.device), _table(part["steps"], self.device)
        if not self.initialized:
            self._make_room(frames[:envs], steps[:envs])
        self._check_part(part)
        self._steps[self._rows(begin, stop)] = steps
        self._starts[self._rows(begin, stop)] = part["starts"].to(self.device)
        self._frames[self._frame_rows(int(part["first_frame"]), stop + 1)] = frames
        ends = part["ends"].to(self.device)
        self._ends[self._rows(stop - len(ends) // envs, stop)] = ends
        kept, first = self._ends[self._ends >= 0], int(part["first_end_frame"])
        self._end_frames.first = int(kept.min()) if len(kept) else first
        self._end_frames.stop = max(self._end_frames.stop, self._end_frames.first)
        end_frames = _table(part["end_frames"], self.device)
        self._end_frames.write(end_frames, first + torch.arange(len(end_frames)))
        self._count = stop
        self._finish()

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
        self._count = 0
        self._ends.fill_(-1)
        self._end_frames.first = self._end_frames.stop = 0
        self._len = 0
        self._bump_mutation_revision()

    def _make_room(self, frames: TensorDictBase, steps: TensorDictBase) -> None:
        """Allocates the memory, which the system provides as it is written.

        Args:
            frames: The frames of all environments at one time, [envs].
            steps: The other entries, [envs].
        """
        self._envs = len(frames)
        num_times = -(-self.max_size // self._envs)
        self.max_size = num_times * self._envs

        def room(like: TensorDictBase, times: int) -> TensorDict:
            count = times * self._envs
            tables = {
                key: value.new_empty(count, *value.shape[1:])
                for key, value in like.items(True, True)
            }
            return TensorDict(tables, [count], device=self.device)

        self._steps, self._frames = (
            room(steps, num_times),
            room(frames, num_times + self._num_frames),
        )
        self._end_frames = EndFrames(frames.to(self.device))
        self._starts, self._ends = (
            torch.full((self.max_size,), -1, device=self.device) for _ in range(2)
        )
        self._total_shape_value = torch.Size([num_times, self._envs][: self.ndim])
        self.initialized = True

    def _finish(self) -> None:
        """Tells TorchRL the number of steps and the position of the newest."""
        self._len = min(self._count, self._num_times) * self._envs
        self._set_last_cursor((self._count - 1) % self._num_times)
        self._bump_mutation_revision()


def _select(steps: TensorDictBase) -> TensorDictBase:
    """Selects the entries to store, and "is_init"."""
    groups = ((steps, (), _HERE), (steps["next"], ("next",), _NEXT))
    for group, prefix, names in groups:
        for name in names:
            if name not in group.keys() and name not in _OPTIONAL:  # noqa: SIM118 (a tensordict)
                raise KeyError(
                    f"Steps need {(*prefix, name)}, but have only {sorted(group.keys())}."
                )
    here = steps.select(*_HERE, strict=False)
    return here.set("next", steps["next"].select(*_NEXT, strict=False))


def _fields_of(steps: TensorDictBase) -> TensorDictBase:
    return steps.exclude("observation", "is_init", ("next", "observation"))


def _take_later(table: Tensor, rows: Callable[[], Tensor]) -> Tensor:
    return take(table, rows())


def _flag(steps: TensorDictBase, name: str) -> Tensor:
    """A flag of the steps, [..., 1] -> bool [...]."""
    return steps["next", name].reshape(steps.shape)


def _equal(left: TensorDictBase, right: TensorDictBase) -> Tensor:
    """Whether observations [...] are the same, NaN included; bool [...]."""
    same = torch.ones(left.shape, dtype=torch.bool, device=left.device)
    for key, ours in left.items(True, True):
        theirs = right[key]
        equal = (ours == theirs) | ((ours != ours) & (theirs != theirs))
        same &= equal.unsqueeze(-1).flatten(left.ndim).all(-1)
    return same


def _table(entries: dict[str, Any], device: torch.device) -> TensorDict:
    """Makes a tensordict [R] of tensors [R, ...]."""
    table = TensorDict(entries, device=device)
    return table.auto_batch_size_(1)
