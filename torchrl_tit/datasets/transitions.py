"""Builds episodes from arrays of transitions, the layout of D4RL."""

from __future__ import annotations

import os
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torchrl_tit.datasets.episodes import Episodes
from torchrl_tit.datasets.errors import DatasetError
from torchrl_tit.datasets.memory_mapping import memory_mapped_rows
from torchrl_tit.datasets.tasks import TaskSpaces, check_task_name
from torchrl_tit.datasets.transition_reader import FIELDS, TransitionReader
from torchrl_tit.settings.arguments import checked_arguments
from torchrl_tit.settings.numbers import Steps

Gaps = Literal["error", "cut"]


def episodes_from_arrays(
    observations: ArrayLike,
    actions: ArrayLike,
    rewards: ArrayLike,
    terminals: ArrayLike,
    timeouts: ArrayLike | None = None,
    next_observations: ArrayLike | None = None,
    **settings: Any,
) -> Episodes:
    """Builds episodes from arrays of transitions in chronological order.

    Args:
        observations: [N, *obs]; floats, or integers such as uint8 images, one frame each.
        actions: [N, A] floats, or [N] integers.
        rewards: [N].
        terminals: Whether the transition led to a terminal state; bool [N].
        timeouts: Whether the episode was truncated after it; bool [N].
        next_observations: [N, *obs].
        **settings: As for :func:`episodes_from_transitions`, which describes how missing arrays are
            replaced.

    Returns:
        The episodes.

    Raises:
        DatasetError: If the data cannot be used.

    Example:
        >>> frames = np.zeros((6, 84, 84), dtype=np.uint8)
        >>> ends = np.array([False, False, True] * 2)
        >>> episodes_from_arrays(frames, np.zeros(6, int), np.ones(6), ends).lengths
        tensor([3, 3])
    """
    given = (observations, actions, rewards, terminals, timeouts, next_observations)
    fields = {
        name: _as_array(name, array)
        for name, array in zip(FIELDS, given, strict=True)
        if array is not None
    }
    return episodes_from_transitions(fields, **settings)


def _as_array(name: str, array: ArrayLike) -> NDArray:
    try:
        return np.asarray(array)
    except ValueError as error:  # rows of several lengths
        raise DatasetError("the data", f"is not one array ({error}).", name) from error


@checked_arguments
def episodes_from_transitions(
    fields: Mapping[str, Any],
    *,
    source: str = "the data",
    task: TaskSpaces | None = None,
    max_episode_steps: Steps | None = None,
    gaps: Gaps = "error",
    dtype: torch.dtype | None = torch.float32,
    directory: str | os.PathLike[str] | None = None,
    attributes: Mapping[str, Any] | None = None,
) -> Episodes:
    """Builds episodes from transitions in D4RL's layout, read in chunks.

    An episode ends at a row that ``terminals`` or ``timeouts`` marks. Without ``timeouts``, it is
    also truncated where ``next_observations`` is not the observation of the next row, and after
    ``max_episode_steps`` steps. Without ``next_observations``, final observations are unknown.
    Those of terminal states become zeros, since nothing is learned from them. The last transition
    before a time limit is then used in returns and sequences, but never drawn as a transition.

    Args:
        fields: Arrays by D4RL's names: NumPy arrays or HDF5 data sets, which are read in slices.
            See :func:`episodes_from_arrays` for their shapes.
        source: Name of the source, for error messages.
        task: The task whose shapes and action bounds the data must have; not checked if None.
        max_episode_steps: The time limit of data without ``timeouts``.
        gaps: What to do where ``next_observations`` is not the observation of the next row within
            an episode: ``"error"`` raises, ``"cut"`` truncates the episode there.
        dtype: The dtype for floats; None keeps that of each field. Integers stay integers.
        directory: Folder for the memory-mapped rows; see
            :func:`~torchrl_tit.datasets.memory_mapping.memory_mapped_rows`.
        attributes: Metadata of the source. If they contain "env_id", the name of the task, it must
            be that of ``task``, except for the version.

    Returns:
        The episodes. The last one may be unfinished.

    Raises:
        ValueError: If ``max_episode_steps`` is less than 1, ``gaps`` is not one of the above, or
            ``dtype`` is not a floating-point dtype.
        DatasetError: If a field is missing or empty, has the wrong length, shape or dtype, or
            contains NaN, infinity, or actions out of bounds; if no episode ends; or if
            ``next_observations`` is not the observation of the next row within an episode.

    Example:
        >>> fields = {"observations": np.zeros((2, 3)), "rewards": np.zeros(2)}
        >>> episodes_from_transitions(fields, source="a.hdf5")
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.errors.DatasetError: a.hdf5: field 'actions': is missing; there...
    """
    if not isinstance(task, TaskSpaces | None):
        raise ValueError(f"task must be what task_spaces returns, not {task!r}")
    if task is not None:
        check_task_name(source, (attributes or {}).get("env_id"), task)
    reader = TransitionReader(fields, source, task, dtype)
    terminated = reader.flags("terminals")
    truncated, ends = _ends(reader, terminated, max_episode_steps, gaps)
    last_steps = np.flatnonzero(ends)
    if last_steps.size == 0:
        hint = "" if "timeouts" in fields else "; give max_episode_steps if there is a time limit"
        raise DatasetError(source, f"no episode ends in its {reader.num_rows} rows{hint}.")
    if last_steps[-1] != reader.num_rows - 1:
        last_steps = np.append(last_steps, reader.num_rows - 1)

    rows = memory_mapped_rows(reader.num_rows + len(last_steps), reader.row_fields(), directory)
    # The final observation of an episode is an additional row, so all later rows move by one.
    row_of = np.arange(reader.num_rows)
    row_of[1:] += ends[:-1].cumsum()
    for name in ("observations", "actions", "rewards"):
        for start, values in reader.chunks(name):
            target = torch.from_numpy(row_of[start : start + len(values)])
            rows[_ROW_NAMES[name]][target] = values
    flags = {"terminated": terminated, "truncated": truncated}
    for name, flag in flags.items():
        rows[name][torch.from_numpy(row_of)] = torch.from_numpy(flag).unsqueeze(-1)
    has_next = "next_observations" in fields
    if has_next:
        _place_next_observations(reader, rows["observation"], row_of, ends)
    return Episodes(
        rows=rows,
        lengths=torch.from_numpy(np.diff(last_steps, prepend=-1)),
        final_known=torch.full((len(last_steps),), has_next),
        source=source,
        attributes=attributes or {},
        left_out=tuple(sorted(set(fields) - set(FIELDS))),
    )


_ROW_NAMES = {"observations": "observation", "actions": "action", "rewards": "reward"}


def _ends(
    reader: TransitionReader, terminated: NDArray, max_episode_steps: int | None, gaps: Gaps
) -> tuple[NDArray, NDArray]:
    """Where episodes were truncated, and where they end; bool [N] each."""
    marked = "timeouts" in reader.fields
    truncated = reader.flags("timeouts") if marked else np.zeros_like(terminated)
    if "next_observations" in reader.fields and (gaps == "cut" or not marked):
        truncated |= _gaps(reader) & ~terminated
    ends = terminated | truncated
    if max_episode_steps is not None and not marked:
        bounds = [-1, *np.flatnonzero(ends), len(ends) - 1]
        for before, last in pairwise(bounds):
            truncated[before + max_episode_steps : last + 1 : max_episode_steps] = True
        truncated &= ~terminated
    return truncated, terminated | truncated


def _gaps(reader: TransitionReader) -> NDArray:
    """Where the next observation is not the observation of the next row; bool [N]."""
    gaps = np.zeros(reader.num_rows, dtype=bool)
    for start, following in reader.chunks("next_observations"):
        # The last row has no next row to compare with.
        after = reader.read("observations", start + 1, start + 1 + len(following))
        differs = (following[: len(after)] != after).flatten(1).any(1)
        gaps[start : start + len(after)] = differs.numpy()
    return gaps


def _place_next_observations(
    reader: TransitionReader, observations: Tensor, row_of: NDArray, ends: NDArray
) -> None:
    """Writes the final observations, and checks the others; row_of int64 [N]."""
    for start, following in reader.chunks("next_observations"):
        part = slice(start, start + len(following))
        target = torch.from_numpy(row_of[part] + 1)
        # At the end of an episode, and after the very last row, there is nothing to compare with.
        is_final = torch.from_numpy(ends[part].copy())
        is_final[reader.num_rows - 1 - start :] = True
        observations[target[is_final]] = following[is_final]
        differs = (observations[target] != following).flatten(1).any(1)
        if differs.any():
            raise DatasetError(
                reader.source,
                "is not the observation of the next row, but the episode continues there; "
                'gaps="cut" truncates it there.',
                "next_observations",
                start + int(differs.int().argmax()),
            )
