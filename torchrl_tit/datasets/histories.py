"""Transitions with histories, gathered from episodes when they are drawn."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Literal, get_args

import torch
from torch import Tensor

from torchrl_tit.datasets.episodes import Episodes
from torchrl_tit.datasets.gathering import Entries, take
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
    history never contains observations of another episode. "episode", int64, is the number of the
    item's episode, as TorchRL's `SliceSampler` expects it.

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
            because the data end there. If such an episode is kept, no flag marks its end.
        is_init: Whether items have "is_init" and ("next", "is_init") [1], True at the first step of
            an episode. In slices of consecutive items, a :class:`~torchrl_tit.modules.Backbone`
            then encodes each frame once.

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
        if not isinstance(episodes, Episodes):
            raise ValueError(f"episodes must be Episodes, as of load_episodes, not {episodes!r}")
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
        # A history of one frame needs no padding.
        self._padding: Padding = padding if num_frames > 1 else "same"
        self._zero_terminals = terminal_observations == "zero"
        self._is_init = is_init

    def _cut(self, row: Tensor, episode: Tensor) -> Entries:
        frames, first = self._fields["observation"], self._first_rows[episode]
        terminated, truncated = (
            partial(self._take, name, row) for name in ("terminated", "truncated")
        )

        def following() -> Tensor:
            values = take(frames, row + 1)
            if not self._zero_terminals:
                return values
            mask = terminated().view(*row.shape, *[1] * (values.ndim - row.ndim))
            return values.masked_fill_(mask, 0)

        def action() -> Tensor:
            values = self._take("action", row)
            return values if values.is_floating_point() else values.long()  # losses use it as index

        def history() -> Tensor:
            windows = find_windows(row, first, self._num_frames, self._padding)
            return windows.gather(frames)

        return {
            **frame_entries((), partial(take, frames, row), history, following, row.ndim),
            "action": action,
            ("next", "reward"): partial(self._take, "reward", row),
            ("next", "terminated"): terminated,
            ("next", "truncated"): truncated,
            ("next", "done"): lambda: terminated() | truncated(),
            **episode_entries(episode, (row == first) if self._is_init else None),
        }


def frame_entries(
    leaf: tuple[str, ...],
    newest: Callable[[], Tensor],
    history: Callable[[], Tensor],
    following: Callable[[], Tensor],
    ndim: int,
) -> Entries:
    """Returns how to compute an observation and its histories, without views of each other.

    Args:
        leaf: The rest of the keys after "observation" and "history": empty, or the name of one of
            several observations.
        newest: Computes the observation, [..., *obs].
        history: Computes the history, [..., K, *obs].
        following: Computes the next observation, [..., *obs].
        ndim: Number of leading dimensions.
    """
    history, following = cache(history), cache(following)

    def moved() -> Tensor:
        kept = history().narrow(ndim, 1, history().shape[ndim] - 1)
        return torch.cat([kept, following().unsqueeze(ndim)], ndim)

    return {
        ("observation", *leaf): newest,
        ("history", *leaf): history,
        ("next", "observation", *leaf): following,
        ("next", "history", *leaf): moved,
    }


def episode_entries(episode: Tensor, starts: Tensor | None) -> Entries:
    """Returns how to compute the entries that tell the episodes of items apart.

    Args:
        episode: The number of each item's episode, int64 [...].
        starts: True where an episode begins, bool [...], for "is_init". It also holds for the next
            steps, whose histories do not continue others either.
    """
    entries: Entries = {"episode": lambda: episode}
    if starts is not None:
        for key in ("is_init", ("next", "is_init")):
            entries[key] = starts.unsqueeze(-1).clone
    return entries


def check_windows(num_frames: int, padding: str) -> None:
    """Checks the settings of windows.

    Args:
        num_frames: Number of frames in a window.
        padding: What replaces missing frames.

    Raises:
        TypeError: If the number is not an integer.
        ValueError: If it is less than 1, or the padding is unknown.
    """
    if isinstance(num_frames, bool) or not isinstance(num_frames, int):
        raise TypeError(f"num_frames must be an integer, not {num_frames!r}")
    if num_frames < 1:
        raise ValueError(f"num_frames must be at least 1, not {num_frames}")
    _check_choice("padding", padding, get_args(Padding))


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        known = ", ".join(map(repr, choices))
        raise ValueError(f"{name} must be one of {known}, not {value!r}")
