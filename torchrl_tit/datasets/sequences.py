"""Windows of episodes on which Decision Transformer is trained."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchrl_tit.datasets.episodes import Episodes
from torchrl_tit.datasets.gathering import Entries
from torchrl_tit.datasets.storage import EpisodeStorage
from torchrl_tit.settings.arguments import checked_arguments
from torchrl_tit.settings.numbers import Frames, Positive, Real


class SequenceStorage(EpisodeStorage):
    """Windows of up to K steps that start at any step of a finished episode, padded on the left.

    An item has "observation" [K, *obs], "action" [K, *action] (int64 if it is discrete),
    "return_to_go" [K, 1], "timestep" int64 [K] and "mask" bool [K], which is False at padding.
    A uniformly drawn index selects an episode with a probability proportional to its length, and a
    uniformly distributed start within it.

    Args:
        episodes: The data.
        num_frames: Number K of steps, at least 1.
        return_scale: Divisor of the returns-to-go.
        action_padding: Value of the actions at padding, where all other entries are 0.

    Raises:
        ValueError: If ``num_frames`` is less than 1, or ``return_scale`` is not positive.
        DatasetError: If no episode is finished.

    Source: "Decision Transformer" (arXiv 2106.01345), section 3 and its authors' code.

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
    ) -> None:
        super().__init__(episodes, episodes.lengths * episodes.finished)
        self._last_rows = episodes.last_rows
        self._returns_to_go = _returns_to_go(episodes).div_(return_scale).float()  # [R]
        self._action_padding = action_padding
        self._steps = torch.arange(num_frames, device=self.device)

    def _cut(self, row: Tensor, episode: Tensor) -> Entries:
        row, last = row.unsqueeze(-1), self._last_rows[episode].unsqueeze(-1)
        length = (last - row + 1).clamp(max=len(self._steps))  # [..., 1]
        step = self._steps - (len(self._steps) - length)  # [..., K]: below 0 at padding
        mask = step >= 0
        rows = row + step.clamp(min=0)

        def action() -> Tensor:
            values = self._take("action", rows)  # [..., K, *action]
            if not values.is_floating_point():
                values = values.long()  # padding is negative
            return _fill(values, mask, self._action_padding)

        def timestep() -> Tensor:
            return _fill(rows - self._first_rows[episode].unsqueeze(-1), mask, 0)

        return {
            "observation": lambda: _fill(self._take("observation", rows), mask, 0),
            "action": action,
            "return_to_go": lambda: _fill(self._returns_to_go[rows], mask, 0).unsqueeze(-1),
            "timestep": timestep,
            "mask": mask.clone,
        }


def _fill(values: Tensor, mask: Tensor, padding: float) -> Tensor:
    return values.masked_fill(~mask.view(*mask.shape, *[1] * (values.ndim - mask.ndim)), padding)


def _returns_to_go(episodes: Episodes) -> Tensor:
    """Sum of the rewards from each row to its episode's end; float64 [R]."""
    rewards = episodes.rows["reward"].squeeze(-1).cpu().double().numpy()
    total = np.cumsum(rewards[::-1])[::-1]
    # The row of an episode's final observation has no reward; the sum there is that of later
    # episodes.
    later = torch.from_numpy(total.copy()).to(episodes.lengths.device)
    after = later[episodes.last_rows + 1]
    return later - after.repeat_interleave(episodes.lengths + 1)
