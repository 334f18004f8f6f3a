"""Transitions with the last K observations, cut out of episodes when they are drawn."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_tit.datasets.episodes import Episodes
from torchrl_tit.datasets.storage import EpisodeStorage
from torchrl_tit.transforms.history import Padding, check_history

TimeLimits = Literal["keep", "drop"]
TerminalObservations = Literal["keep", "zero"]
Unfinished = Literal["keep", "drop"]


class HistoryStorage(EpisodeStorage):
    """Transitions whose observation and next observation come as histories.

    An item has "observation" [*obs], "history" [K, *obs], "action" (int64 if it is discrete), and
    under "next" "observation", "history", "reward" [1], "terminated" [1], "truncated" [1] and
    "done" [1]: what an environment with :class:`~torchrl_tit.transforms.History` gives on the same
    stream. A history never reaches into another episode.

    Args:
        episodes: The data.
        num_frames: K, the number of observations in a history, at least 1.
        padding: What stands for the steps before an episode's first: ``"same"`` repeats the first
            observation, ``"constant"`` writes zeros.
        time_limits: ``"drop"`` leaves out the last transition of an episode that a time limit cut
            off, as d3rlpy 1 did. Without a known next observation it is left out in any case.
        terminal_observations: ``"zero"`` puts zeros for the observation of a terminal state, as
            d3rlpy 1 did. Where it is unknown, it is zeros in any case.
        unfinished: Whether an episode without an end, with which the data break off, is left out.
            Where it is kept, no flag marks its end.

    Raises:
        TypeError: If ``num_frames`` is not an integer.
        ValueError: If it is less than 1, or another setting is none of the above.
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
        check_history(num_frames, padding)
        _check_choice("time_limits", time_limits, ("keep", "drop"))
        _check_choice("terminal_observations", terminal_observations, ("keep", "zero"))
        _check_choice("unfinished", unfinished, ("keep", "drop"))
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
        # One window holds both histories: K steps up to this one, and the next one.
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
            action = action.long()  # losses take it for an index
        if self._zero_terminals:
            window.select(time, -1).masked_fill_(_expand(terminated, ndim - 1), 0)
        return TensorDict(
            {
                "observation": window.select(time, self._num_frames - 1),
                # A copy, so that the two histories can be changed apart.
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
    """A mask with as many dimensions more; [..., 1, 1]."""
    return mask.view(*mask.shape, *[1] * ndim)


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        known = ", ".join(map(repr, choices))
        raise ValueError(f"{name} must be one of {known}, but is {value!r}.")
