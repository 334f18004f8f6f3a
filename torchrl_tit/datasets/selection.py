"""Selecting and joining episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from torchrl_tit.datasets.episodes import Episodes


def select_episodes(episodes: Episodes, index: Tensor) -> Episodes:
    """Copies some of the episodes.

    Args:
        episodes: The data.
        index: Indices of the episodes, in the order of the result; int64 [M].

    Returns:
        The selected episodes.

    Example:
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> states, ends = torch.arange(5.0).view(5, 1), [False, True, False, False, True]
        >>> episodes = episodes_from_arrays(states, states, torch.ones(5), ends)
        >>> select_episodes(episodes, torch.tensor([1])).rows["observation"].flatten()
        tensor([2., 3., 4., 0.])
    """
    lengths = episodes.lengths[index] + 1  # including the final observation
    shifts = episodes.first_rows[index] - (lengths.cumsum(0) - lengths)
    steps = torch.arange(int(lengths.sum()), device=lengths.device)
    rows = steps + shifts.repeat_interleave(lengths)
    return replace(
        episodes,
        rows=episodes.rows[rows],
        lengths=episodes.lengths[index],
        final_known=episodes.final_known[index],
    )


def join_episodes(parts: Sequence[Episodes]) -> Episodes:
    """Concatenates data sets.

    Args:
        parts: Data sets with the same fields, at least one; the result has the source and the
            attributes of the first.

    Returns:
        The episodes of all of them.

    Example:
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> states, ends = torch.zeros(3, 1), [False, False, True]
        >>> episodes = episodes_from_arrays(states, states, torch.ones(3), ends)
        >>> join_episodes([episodes, episodes]).lengths
        tensor([3, 3])
    """
    return replace(
        parts[0],
        rows=torch.cat([part.rows for part in parts]),
        lengths=torch.cat([part.lengths for part in parts]),
        final_known=torch.cat([part.final_known for part in parts]),
    )
