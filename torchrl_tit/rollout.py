"""Collected batches that keep each observation once, and the windows of their steps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.nn.functional import pad

from torchrl_tit.modules import ActingCollector
from torchrl_tit.modules.frame_tables import table_of_first
from torchrl_tit.settings.choices import Padding
from torchrl_tit.transforms import frames_before
from torchrl_tit.windows import Windows, find_windows, take


class FrameCollector(ActingCollector):
    """A collector of batches that hold each observation once, for :class:`Rollout`.

    Its environments remove the histories from the steps that were taken
    (``make_env(..., keep_histories=False)``). The K - 1 frames that precede the batch are in
    ``before``, or in ``("before", NAME)`` for each of several observations, cut into as many pieces
    as there are steps: an entry [envs, time, size] like any other, which passes between processes
    and is stacked with the others.
    """

    def rollout(self) -> TensorDictBase:
        """Collects a batch, [envs, time]."""
        older = {
            ("before", *key[1:]) if isinstance(key, tuple) else "before": frames.flatten(1)
            for key, frames in frames_before(self.env).items()
        }
        batch = super().rollout()
        for key, entries in older.items():
            steps = batch.shape[1]  # the last pieces are padded
            batch[key] = pad(entries, (0, -entries.shape[1] % steps)).unflatten(1, (steps, -1))
        return batch


class Rollout:
    """The frames of a batch, each stored once, and the positions of its steps' windows.

    The frames of an environment are in chronological order: the K - 1 that precede the batch, then
    the observation of each step. Where an episode or the batch ends, the true next observation
    follows, since it is the observation of no other step. That is at most
    ``steps x envs + envs x K + episode ends`` frames. A frame consists of one tensor for each
    observation; all observations have the same windows.

    Args:
        batch: of a :class:`FrameCollector`, [envs, time]. Its observations are removed.
        num_frames: number K of frames in a window.
        padding: what precedes an episode's first observation.
        keys: keys of the observations: "observation", or ``("observation", NAME)`` of each.

    Example:
        >>> from torchrl.modules import RandomPolicy
        >>> from torchrl_tit.envs import make_env
        >>> env = make_env("CartPole-v1", 2, num_frames=4, keep_histories=False)
        >>> policy = RandomPolicy(env.action_spec)
        >>> collector = FrameCollector(
        ...     env,
        ...     policy,
        ...     frames_per_batch=64,
        ...     total_frames=64,
        ...     auto_register_policy_transforms=False,
        ... )
        >>> batch = next(iter(collector))
        >>> rollout = Rollout(batch, num_frames=4, padding="same")
        >>> [history] = rollout.histories(torch.arange(32))  # of the first environment
        >>> history.shape
        torch.Size([32, 4, 4])
        >>> collector.shutdown()
    """

    def __init__(
        self,
        batch: TensorDictBase,
        num_frames: int,
        padding: Padding,
        keys: Sequence[NestedKey] = ("observation",),
    ) -> None:
        self.num_frames = num_frames
        self.padding = padding
        done = batch["next", "done"].squeeze(-1)
        is_init = done.roll(1, dims=1)
        is_init[:, 0] = False  # even if one begins there: its window is known
        self.is_init = is_init.flatten()
        """Whether an episode begins, other than at the start of the batch, bool [steps]."""
        self.ends = done.clone()
        """Whether the true next observation is not in the batch, bool [envs, time]."""
        self.ends[:, -1] = True

        envs, steps = done.shape
        ends = self.ends.flatten()
        past = num_frames - 1
        # The rows before a step are the frames that precede the batch in the environments up to its
        # own, the earlier steps, and the true next observations that follow some of them.
        precede = torch.arange(1, envs + 1, device=done.device).repeat_interleave(steps) * past
        before = torch.arange(len(ends), device=done.device) + ends.cumsum(0) - ends.long()
        self.newest = precede + before
        """Row of each step's observation, int64 [steps]."""
        newest = self.newest.view(envs, steps)
        begins = torch.where(is_init, newest, 0)
        begins[:, 0] = newest[:, 0] - past
        self.oldest = begins.cummax(1).values.flatten()
        """The first row that belongs to each step's window, int64 [steps]."""

        count = envs * (past + steps) + int(ends.sum())
        earlier = newest[:, :1] - torch.arange(past, 0, -1, device=done.device)
        self.frames: list[Tensor] = []
        """The frames, [R, *observation_shape] of each observation."""
        for key in keys:
            observation, following = batch.get(key), batch["next"].get(key)
            frames = observation.new_empty(count, *observation.shape[2:])
            frames[self.newest] = observation.flatten(0, 1)
            frames[self.newest[ends] + 1] = following[self.ends]
            if past:
                older = batch.get(("before", *key[1:]) if isinstance(key, tuple) else "before")
                shape = (past, *observation.shape[2:])
                older = older.flatten(1)[:, : torch.Size(shape).numel()]
                frames[earlier] = older.unflatten(1, shape)
            self.frames.append(frames)
        batch.pop("before", None)
        for part in (batch, batch["next"]):
            part.del_("observation")

    def histories(self, steps: Tensor) -> list[Tensor]:
        """The windows of steps, int64 [...] -> [..., K, *observation_shape] of each observation."""
        windows = self._windows(self.newest[steps], self.oldest[steps])
        return [windows.gather(frames) for frames in self.frames]

    def sequences(self, steps: Tensor) -> tuple[list[Tensor], Windows]:
        """The frames of sequences of consecutive steps, each once, and the windows of the steps.

        All shapes are static.

        Args:
            steps: int64 [N, T].

        Returns:
            Frames, [N * (K - 1 + T), *observation_shape] of each observation, and windows on them,
            [N, T, K].
        """
        observations = [take(frames, self.newest[steps]) for frames in self.frames]
        first = self.histories(steps[:, 0])
        return table_of_first(first, observations, self.is_init[steps], self.padding)[:2]

    def next_windows(
        self, steps: Tensor, max_frames: int = 1024
    ) -> Iterator[tuple[list[Tensor], Windows]]:
        """Yields the windows of the true next states of steps, in their order.

        Args:
            steps: the E steps, among ``ends``, bool [envs, time].
            max_frames: maximum number of frames to encode at once, but at least one window.

        Yields:
            Frames, each once, [R, *observation_shape] of each observation, and the next windows on
            them, [..., K]; E windows in all, and nothing if there are none.
        """
        chosen = steps.flatten()
        newest, oldest = self.newest[chosen] + 1, self.oldest[chosen]
        if not len(newest):  # split would make one empty part
            return
        size = max(1, max_frames // self.num_frames)
        for pair in zip(newest.split(size), oldest.split(size), strict=True):
            rows, windows = self._windows(*pair).used()
            yield [frames.index_select(0, rows) for frames in self.frames], windows

    def _windows(self, newest: Tensor, oldest: Tensor) -> Windows:
        return find_windows(newest, oldest, self.num_frames, self.padding)
