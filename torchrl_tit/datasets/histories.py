"""Transitions with histories, gathered from episodes when they are drawn."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_tit.datasets.episodes import Episodes
from torchrl_tit.datasets.storage import EpisodeStorage
from torchrl_tit.transforms.history import Padding

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
    ) -> None:
        if isinstance(num_frames, bool) or not isinstance(num_frames, int):
            raise TypeError(f"num_frames must be an integer, but is {num_frames!r}.")
        if num_frames < 1:
            raise ValueError(f"num_frames must be at least 1, but is {num_frames}.")
        _check_choice("padding", padding, get_args(Padding))
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
        self._constant = padding == "constant" and num_frames > 1
        self._zero_terminals = terminal_observations == "zero"
        # One window contains both histories: K steps up to this one, and the next one.
        self._steps = torch.arange(1 - num_frames, 2, device=self.device)

    def _cut(self, row: Tensor, episode: Tensor) -> TensorDict:
        terminated, truncated = self._take("terminated", row), self._take("truncated", row)
        rows = row.unsqueeze(-1) + self._steps  # [..., K + 1]
        first = self._first_rows[episode].unsqueeze(-1)
        window = self._take("observation", rows.maximum(first))  # [..., K + 1, *obs]
        time, ndim = row.ndim, window.ndim - rows.ndim
        if self._constant:
            window.masked_fill_(_expand(rows < first, ndim), 0)
        action = self._take("action", row)
        if not action.is_floating_point():
            action = action.long()  # losses use it as an index
        if self._zero_terminals:
            window.select(time, -1).masked_fill_(_expand(terminated, ndim - 1), 0)
        return TensorDict(
            {
                "observation": window.select(time, self._num_frames - 1),
                # A copy, so that writing into one history does not change the other.
                "history": window.narrow(time, 0, self._num_frames).clone(),
                "action": action,
                "next": TensorDict(
                    {
                        "observation": window.select(time, self._num_frames),
                        "history": window.narrow(time, 1, self._num_frames).clone(),
                        "reward": self._take("reward", row),
                        "terminated": terminated,
                        "truncated": truncated,
                        "done": terminated | truncated,
                    },
                    row.shape,
                ),
            },
            row.shape,
        )


def _expand(mask: Tensor, ndim: int) -> Tensor:
    """Appends ``ndim`` dimensions to a mask; [...] -> [..., 1, 1]."""
    return mask.view(*mask.shape, *[1] * ndim)


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        known = ", ".join(map(repr, choices))
        raise ValueError(f"{name} must be one of {known}, but is {value!r}.")
