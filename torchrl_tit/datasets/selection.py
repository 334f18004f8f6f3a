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

    Raises:
        ValueError: If there is no such episode.

    Example:
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> states, ends = torch.arange(5.0).view(5, 1), [False, True, False, False, True]
        >>> episodes = episodes_from_arrays(states, states, torch.ones(5), ends)
        >>> select_episodes(episodes, torch.tensor([1])).rows["observation"].flatten()
        tensor([2., 3., 4., 0.])
    """
    index = torch.as_tensor(index)
    count = len(episodes.lengths)
    if index.is_floating_point() or ((index < 0) | (index >= count)).any():
        raise ValueError(f"index must be integers from 0 to {count - 1}, not {index.tolist()}")
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

    Raises:
        ValueError: If there are none, or the shapes or dtypes of their fields differ.

    Example:
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> states, ends = torch.zeros(3, 1), [False, False, True]
        >>> episodes = episodes_from_arrays(states, states, torch.ones(3), ends)
        >>> join_episodes([episodes, episodes]).lengths
        tensor([3, 3])
    """
    if not parts:
        raise ValueError("there are no data sets to join")
    for part in parts:
        for name, field in parts[0].rows.items():
            other = part.rows[name]
            if (other.shape[1:], other.dtype) != (field.shape[1:], field.dtype):
                raise ValueError(
                    f"{part.source}: field {name!r} has the shape {list(other.shape[1:])} and "
                    f"{other.dtype}, but in {parts[0].source} {list(field.shape[1:])} and "
                    f"{field.dtype}: data sets of one task and dtype can be joined"
                )
    return replace(
        parts[0],
        rows=torch.cat([part.rows for part in parts]),
        lengths=torch.cat([part.lengths for part in parts]),
        final_known=torch.cat([part.final_known for part in parts]),
    )
