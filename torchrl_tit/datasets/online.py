"""A TorchRL storage for collected steps that keeps each frame once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Storage

from torchrl_tit.datasets.histories import check_windows, make_item, mark_starts
from torchrl_tit.datasets.storage import as_indices, take
from torchrl_tit.windows import Padding, find_windows

_OUTCOMES = ("reward", "terminated", "truncated", "done")


class OnlineHistoryStorage(Storage):
    """Collected steps, whose items have histories like those of :class:`HistoryStorage`.

    Each observation is stored once. In addition, there is a frame for each end of an episode (its
    last observation, which the next step does not have) and one for each environment (its newest
    next observation). Histories are gathered when items are drawn, and equal those of
    :class:`~torchrl_tit.transforms.History` in the environment. Actions, rewards and flags are
    stored as they come.

    Steps are appended, the environments taking turns: a batch [envs, T] of a collector is extended
    as ``batch.transpose(0, 1).reshape(-1)``. An episode ends where a step is done, where the next
    one has "is_init", and where its observation is not the next observation of the step before (an
    environment that was reset in between). Nothing is overwritten.

    Args:
        max_size: Number of steps that there is room for. Memory is taken as it is filled.
        num_frames: Number K of observations in a history, at least 1.
        num_envs: Number of environments, which take turns.
        padding: The frames before the first step of an episode: ``"same"`` repeats the first
            observation, ``"constant"`` writes zeros.
        is_init: Whether items have "is_init"; see :class:`HistoryStorage`.
        device: Where the steps are stored.

    Raises:
        TypeError: If ``num_frames`` is not an integer.
        ValueError: If a number is less than 1 or the padding is unknown.

    Example:
        >>> from torchrl.data import ReplayBuffer
        >>> from torchrl.envs import GymEnv
        >>> storage = OnlineHistoryStorage(1000, num_frames=8)
        >>> buffer = ReplayBuffer(storage=storage, collate_fn=lambda batch: batch, batch_size=32)
        >>> _ = buffer.extend(GymEnv("CartPole-v1").rollout(100, break_when_any_done=False))
        >>> buffer.sample()["next", "history"].shape
        torch.Size([32, 8, 4])
    """

    def __init__(
        self,
        max_size: int,
        num_frames: int = 1,
        *,
        num_envs: int = 1,
        padding: Padding = "same",
        is_init: bool = False,
        device: torch.device | str = "cpu",
    ) -> None:
        check_windows(num_frames, padding)
        for name, value in (("max_size", max_size), ("num_envs", num_envs)):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, but is {value}.")
        super().__init__(max_size=max_size)
        self.device = torch.device(device)
        self.stride = num_envs
        """From an item to that of the environment's next step."""
        self._num_frames = num_frames
        self._padding: Padding = padding if num_frames > 1 else "same"
        self._is_init = is_init
        self._fields: dict[str, Tensor] = {}  # of each step: action and outcome
        self._frames = torch.empty(0)  # of each step, then the newest of each environment
        self._starts = torch.empty(0)  # of each step: the step where its episode begins
        # Of each step: the place of its next observation among the last frames, or -1 if the
        # environment's next step has it.
        self._ends = torch.empty(0)
        self._last_frames = torch.empty(0)  # of episodes, with room for more
        self._size = self._num_ends = 0

    @property
    def num_episode_ends(self) -> int:
        """Number of frames that are stored because an episode ended."""
        return self._num_ends

    def set(self, cursor: Any, data: TensorDictBase, *, set_cursor: bool = True) -> None:
        """Appends steps.

        Args:
            cursor: Not read: steps are appended in the order in which they come.
            data: Steps [T * num_envs] with "observation", "action", and under "next" "observation",
                "reward", "terminated" and "done"; other entries are left out.
            set_cursor: False if items are to be changed, which is refused.

        Raises:
            RuntimeError: If there is no room left, or items are to be changed.
            ValueError: If the steps are not those of all environments.
        """
        if not set_cursor:
            raise RuntimeError("Stored steps cannot be changed, only added.")
        data = data.reshape(-1).to(self.device)
        begin, stop, envs = self._size, self._size + len(data), self.stride
        if len(data) % envs:
            raise ValueError(
                f"{len(data)} steps cannot be those of {envs} environments; extend whole batches, "
                "as batch.transpose(0, 1).reshape(-1)."
            )
        if stop > self.max_size:
            raise RuntimeError(
                f"There is room for {self.max_size} steps, but not for {stop}; raise max_size."
            )
        if not self._fields:
            outcome = data["next"].select(*_OUTCOMES, strict=False)
            fields = {"action": data["action"], **outcome.to_dict()}
            self._make_room(data["observation"], fields)
        following, known = data["next", "observation"], min(begin, envs)
        # Of the newest steps stored so far, and of the new ones.
        following = torch.cat([self._frames[begin : begin + known], following])
        done = torch.cat([self._fields["done"][begin - known : begin], data["next", "done"]])
        goes_on = torch.zeros(len(data), dtype=torch.bool, device=self.device)
        goes_on[envs - known :] = ~done[:-envs].squeeze(-1) & _equal(
            following[:-envs], data["observation"][envs - known :]
        )
        is_init = data.get("is_init", None)
        if is_init is not None:
            goes_on &= ~is_init.squeeze(-1)
        self._ends[begin:stop] = -1
        ends = torch.cat([~goes_on[envs - known :], done[-envs:].squeeze(-1)])
        ends &= self._ends[begin - known : stop] < 0
        self._add_last_frames(following[ends], begin - known + ends.nonzero().squeeze(-1))
        rows = torch.arange(begin, stop, device=self.device)
        starts = torch.where(goes_on, -1, rows)
        starts[:known] = starts[:known].maximum(self._starts[begin - known : begin])
        self._starts[begin:stop] = starts.view(-1, envs).cummax(0).values.flatten()
        self._frames[begin:stop] = data["observation"]
        self._frames[stop : stop + envs] = following[-envs:]
        for name, field in self._fields.items():
            field[begin:stop] = data[name] if name == "action" else data["next", name]
        self._size = stop
        self._bump_mutation_revision()

    def get(self, index: int | slice | Sequence[int] | Tensor) -> TensorDict:
        """Gathers items, with the shape of the index; see :meth:`HistoryStorage.get`.

        Args:
            index: Indices of items; negative ones count from the end.

        Raises:
            IndexError: If there is no such item (on a CPU; elsewhere that is not checked).
        """
        row = as_indices(index, len(self), self.device)
        if not self._fields:
            return TensorDict({}, row.shape)
        start = take(self._starts, row)
        windows = find_windows(row, start, self._num_frames, self._padding, self.stride)
        outcome = {name: take(field, row) for name, field in self._fields.items()}
        action, history = outcome.pop("action"), windows.gather(self._frames)
        item = make_item(history, self._next_frames(row), action, outcome, row.ndim)
        return mark_starts(item, row == start) if self._is_init else item

    def __len__(self) -> int:
        return self._size

    def contains(self, item: Any) -> Tensor:
        """Whether there are items of these indices, bool of their shape."""
        index = torch.as_tensor(item, device=self.device)
        return (index < len(self)) & (index >= -len(self))

    def state_dict(self) -> dict[str, Any]:
        """Returns the steps, each frame once."""
        return self.part(0, 0)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Replaces all steps by those of a return value of `state_dict`."""
        self._empty()
        self.add_part(state_dict)

    def part(self, num_steps: int, num_episode_ends: int) -> dict[str, Any]:
        """Returns what was added since an earlier time, to be saved piece by piece.

        Args:
            num_steps: ``len(storage)`` at that time.
            num_episode_ends: ``storage.num_episode_ends`` then.
        """
        stop, known = len(self), min(num_steps, self.stride)
        if stop == num_steps:
            return {}
        return {
            "fields": {name: field[num_steps:stop] for name, field in self._fields.items()},
            "frames": self._frames[num_steps : stop + self.stride],
            "starts": self._starts[num_steps:stop],
            # Whether the newest steps of that time ended an episode may have shown later.
            "ends": self._ends[num_steps - known : stop],
            "last_frames": self._last_frames[num_episode_ends : self._num_ends],
        }

    def add_part(self, part: dict[str, Any]) -> None:
        """Adds what :meth:`part` returned when as many steps were stored as now."""
        if not part:
            return
        part = {name: _to(value, self.device) for name, value in part.items()}
        begin, known = self._size, min(self._size, self.stride)
        stop = begin + len(part["starts"])
        if not self._fields:
            self._make_room(part["frames"], part["fields"])
        for name, field in self._fields.items():
            field[begin:stop] = part["fields"][name]
        self._frames[begin : stop + self.stride] = part["frames"]
        self._starts[begin:stop] = part["starts"]
        rows = torch.arange(0, device=self.device)
        self._add_last_frames(part["last_frames"], rows)
        self._ends[begin - known : stop] = part["ends"]
        self._size = stop
        self._bump_mutation_revision()

    def _empty(self) -> None:
        self._size = self._num_ends = 0

    def _make_room(self, frames: Tensor, fields: dict[str, Tensor]) -> None:
        """Allocates the memory, which the system provides where it is written."""

        def room(like: Tensor, more: int = 0) -> Tensor:
            return like.new_empty(self.max_size + more, *like.shape[1:])

        self._frames = room(frames, self.stride)
        self._last_frames = frames.new_zeros(1, *frames.shape[1:])
        self._fields = {name: room(field) for name, field in fields.items()}
        self._starts, self._ends = (
            torch.empty(self.max_size, dtype=torch.int64, device=self.device) for _ in range(2)
        )

    def _add_last_frames(self, frames: Tensor, rows: Tensor) -> None:
        """Adds next observations that no row has.

        Args:
            frames: [E, *obs].
            rows: of the steps that they follow, int64 [E].
        """
        begin, stop = self._num_ends, self._num_ends + len(frames)
        if stop > len(self._last_frames):
            more = self._last_frames.new_zeros(2 * stop, *frames.shape[1:])
            more[:begin] = self._last_frames[:begin]
            self._last_frames = more
        self._last_frames[begin:stop] = frames
        self._ends[rows] = torch.arange(begin, begin + len(rows), device=self.device)
        self._num_ends = stop

    def _next_frames(self, row: Tensor) -> Tensor:
        """The next observations of steps, int64 [...] -> [..., *obs]."""
        end = take(self._ends, row)
        frames = take(self._frames, row + self.stride)
        last = take(self._last_frames, end.clamp(min=0))
        here = (end < 0).view(*row.shape, *[1] * (frames.ndim - row.ndim))
        return torch.where(here, frames, last)


def _equal(left: Tensor, right: Tensor) -> Tensor:
    """Whether observations are the same, NaN included; [N, *obs] each -> bool [N]."""
    same = (left == right) | ((left != left) & (right != right))
    return same.flatten(1).all(dim=1)


def _to(value: Any, device: torch.device) -> Any:
    if isinstance(value, Tensor):
        return value.to(device)
    return {name: _to(entry, device) for name, entry in value.items()}
