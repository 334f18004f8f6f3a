"""Transitions with histories, gathered from episodes when they are drawn."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_tit.datasets.episodes import Episodes
from torchrl_tit.datasets.storage import EpisodeStorage
from torchrl_tit.windows import Padding, find_windows

TimeLimits = Literal["keep", "drop"]
TerminalObservations = Literal["keep", "zero"]
Unfinished = Literal["keep", "drop"]


class HistoryStorage(EpisodeStorage):
    """Transitions with the histories of the observation and of the next observation.

    An item has "observation" [*obs], "history" [K, *obs], "action" (int64 if it is discrete), and
    under "next" "observation", "history", "reward" [1], "terminated" [1], "truncated" [1] and
    "done" [1], like the steps of an environment with :class:`~torchrl_tit.transforms.History`. A
    history never contains observations of another episode.

    Args:
        episodes: The data.
        num_frames: Number K of observations in a history, at least 1.
        padding: The frames before the first step of an episode: ``"same"`` repeats the first
            observation, ``"constant"`` writes zeros.
        time_limits: ``"drop"`` leaves out the last transition of truncated episodes, as d3rlpy 1
            does. It is always left out if the next observation is unknown.
        terminal_observations: ``"zero"`` replaces the observations of terminal states with zeros,
            as d3rlpy 1 does. They are always zeros if unknown.
        unfinished: ``"drop"`` leaves out an episode that is neither terminated nor truncated
            because the data end there. If it is kept, no flag marks its end.
        is_init: Whether items have "is_init" and ("next", "is_init") [1], True at the first step of
            an episode: for slices of consecutive items, of which a
            :class:`~torchrl_tit.modules.Backbone` then encodes each frame once.

    Raises:
        TypeError: If ``num_frames`` is not an integer.
        ValueError: If it is less than 1, or another setting is not one of the above.
        DatasetError: If no transition is left.

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

    def __init__(
        self,
        episodes: Episodes,
        num_frames: int = 1,
        *,
        padding: Padding = "same",
        time_limits: TimeLimits = "keep",
        terminal_observations: TerminalObservations = "keep",
        unfinished: Unfinished = "drop",
        is_init: bool = False,
    ) -> None:
        check_windows(num_frames, padding)
        _check_choice("time_limits", time_limits, get_args(TimeLimits))
        zero_or_keep = get_args(TerminalObservations)
        _check_choice("terminal_observations", terminal_observations, zero_or_keep)
        _check_choice("unfinished", unfinished, get_args(Unfinished))
        left_out = ~episodes.final_known
        if time_limits == "drop":
            left_out = left_out | episodes.truncated
        counts = episodes.lengths - (left_out & ~episodes.terminated).long()
        if unfinished == "drop":
            counts = counts * episodes.finished
        super().__init__(episodes, counts)
        self._num_frames = num_frames
        # Of one frame nothing is ever missing.
        self._padding: Padding = padding if num_frames > 1 else "same"
        self._zero_terminals = terminal_observations == "zero"
        self._is_init = is_init

    def _cut(self, row: Tensor, episode: Tensor) -> TensorDict:
        first = self._first_rows[episode]
        windows = find_windows(row, first, self._num_frames, self._padding)
        following = self._take("observation", row + 1)
        action = self._take("action", row)
        if not action.is_floating_point():
            action = action.long()  # losses use it as an index
        terminated, truncated = self._take("terminated", row), self._take("truncated", row)
        if self._zero_terminals:
            mask = terminated.view(*row.shape, *[1] * (following.ndim - row.ndim))
            following.masked_fill_(mask, 0)
        outcome = {
            "reward": self._take("reward", row),
            "terminated": terminated,
            "truncated": truncated,
            "done": terminated | truncated,
        }
        history = windows.gather(self._fields["observation"])
        item = make_item(history, following, action, outcome, row.ndim)
        return mark_starts(item, row == first) if self._is_init else item


def make_item(
    history: Tensor, following: Tensor, action: Tensor, outcome: dict[str, Tensor], ndim: int
) -> TensorDict:
    """Makes items of transitions, no entry of which is a view of another.

    Args:
        history: [..., K, *obs].
        following: The next observation, [..., *obs].
        action: [..., *action].
        outcome: Reward and flags, [..., 1] each.
        ndim: Number of the dimensions before these.
    """
    shape = history.shape[:ndim]
    moved = torch.cat(
        [history.narrow(ndim, 1, history.shape[ndim] - 1), following.unsqueeze(ndim)], ndim
    )
    return TensorDict(
        {
            "observation": history.select(ndim, -1).clone(),
            "history": history,
            "action": action,
            "next": TensorDict({"observation": following, "history": moved, **outcome}, shape),
        },
        shape,
    )


def mark_starts(item: TensorDict, starts: Tensor) -> TensorDict:
    """Adds "is_init" to items, and to the next steps, whose histories are no continuation either.

    Args:
        item: items [...].
        starts: where an episode begins, bool [...].
    """
    for group in (item, item["next"]):
        group["is_init"] = starts.unsqueeze(-1)
    return item


def check_windows(num_frames: int, padding: str) -> None:
    """Checks the settings of windows.

    Args:
        num_frames: Number of frames of a window.
        padding: What takes the place of missing ones.

    Raises:
        TypeError: If the number is not an integer.
        ValueError: If it is less than 1, or the padding is unknown.
    """
    if isinstance(num_frames, bool) or not isinstance(num_frames, int):
        raise TypeError(f"num_frames must be an integer, but is {num_frames!r}.")
    if num_frames < 1:
        raise ValueError(f"num_frames must be at least 1, but is {num_frames}.")
    _check_choice("padding", padding, get_args(Padding))


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        known = ", ".join(map(repr, choices))
        raise ValueError(f"{name} must be one of {known}, but is {value!r}.")
