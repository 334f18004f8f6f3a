"""Builds episodes from transitions in the layout of D4RL."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from torchrl_tit.datasets.checks import (
    FLAGS,
    DatasetError,
    TaskSpaces,
    check_actions,
    check_bytes,
    check_finite,
    check_limit,
    check_shape,
    check_task_name,
    kept_dtype,
    plain_tensor,
)
from torchrl_tit.datasets.episodes import Episodes, memory_mapped_rows, rows_per_chunk
from torchrl_tit.datasets.hdf5_files import damage_named
from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.choices import Gaps
from torchrl_tit.settings.numbers import Steps

FIELDS = ("observations", "actions", "rewards", "terminals", "timeouts", "next_observations")
CUTS = "cuts"
"""A further field: whether an episode ends with a row only because the data end or have a gap."""
TIMESTAMPS = "timestamps"
"""A further field, which is checked and not kept."""
_REQUIRED = FIELDS[:4]
_NUMBERS = (*FLAGS, "rewards", CUTS)  # fields with one number a row


def episodes_from_arrays(
    observations: ArrayLike,
    actions: ArrayLike,
    rewards: ArrayLike,
    terminals: ArrayLike,
    timeouts: ArrayLike | None = None,
    next_observations: ArrayLike | None = None,
    timestamps: ArrayLike | None = None,
    **settings: Any,
) -> Episodes:
    """Builds episodes from arrays of transitions in chronological order.

    Args:
        observations: [N, *obs]; floats, or integers such as uint8 images, one frame each.
        actions: [N, A] floats, or [N] integers.
        rewards: [N].
        terminals: whether the transition led to a terminal state; bool [N].
        timeouts: whether the episode was truncated after it; bool [N].
        next_observations: [N, *obs].
        timestamps: times of the steps in any unit, [N], to check their order.
        **settings: as for :func:`episodes_from_transitions`, which describes how missing arrays are
            replaced.

    Returns:
        The episodes.

    Raises:
        DatasetError: if the data cannot be used.

    Example:
        >>> frames = np.zeros((6, 84, 84), dtype=np.uint8)
        >>> ends = np.array([False, False, True] * 2)
        >>> episodes_from_arrays(frames, np.zeros(6, int), np.ones(6), ends).lengths
        tensor([3, 3])
    """
    given = (observations, actions, rewards, terminals, timeouts, next_observations, timestamps)
    fields = {}
    for name, array in zip((*FIELDS, TIMESTAMPS), given, strict=True):
        if array is not None:
            try:
                fields[name] = np.asarray(array)
            except ValueError as error:  # rows of several lengths
                raise DatasetError("the data", f"is not one array ({error}).", name) from error
    return episodes_from_transitions(fields, **settings)


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
    lengths: NDArray | None = None,
) -> Episodes:
    """Builds episodes from transitions in D4RL's layout, read in chunks.

    An episode ends at a row that ``terminals`` or ``timeouts`` marks. Without ``timeouts``, it is
    also truncated where ``next_observations`` is not the observation of the next row, and after
    ``max_episode_steps`` steps. Without ``next_observations``, final observations are unknown.
    Those of terminal states become zeros, since nothing is learned from them. The last transition
    before a time limit is then used in returns and sequences, but never drawn as a transition.

    Args:
        fields: arrays by D4RL's names: NumPy arrays or HDF5 data sets, which are read in slices.
            See :func:`episodes_from_arrays` for their shapes.
        source: name of the source, for error messages.
        task: the task whose shapes and action bounds the data must have; not checked if None.
        max_episode_steps: the time limit of data without ``timeouts``; no episode may be longer.
        gaps: what to do where, within an episode, ``next_observations`` is not the observation of
            the next row, or ``timestamps`` are more than one and a half times their median interval
            apart: ``"error"`` raises, ``"cut"`` truncates the episode there.
        dtype: the dtype for floats; None keeps that of each field. Integers stay integers.
        directory: folder for the memory-mapped rows; see
            :func:`~torchrl_tit.datasets.episodes.memory_mapped_rows`.
        attributes: metadata of the source. If they contain "env_id", the name of the task, it must
            be that of ``task``, except for the version.
        lengths: number of steps of each episode, if the source says so; int64 [E], in all N; needs
            ``timeouts``. Episodes then end there only, also without a flag.

    Returns:
        The episodes. The last one may be unfinished.

    Raises:
        ValueError: if ``max_episode_steps`` is less than 1, ``gaps`` is not one of the above, or
            ``dtype`` is not a floating-point dtype.
        DatasetError: if a field is missing or empty, has the wrong length, shape or dtype, or
            contains NaN, infinity, or actions out of bounds; if no episode ends, or one is longer
            than ``max_episode_steps``; or if, within an episode, there are gaps or ``timestamps``
            go backwards.

    Example:
        >>> fields = {"observations": np.zeros((2, 3)), "rewards": np.zeros(2)}
        >>> episodes_from_transitions(fields, source="a.hdf5")
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.checks.DatasetError: a.hdf5: field 'actions': is missing; there...
    """
    if not isinstance(task, TaskSpaces | None):
        raise ValueError(f"task must be what task_spaces returns, not {task!r}")
    if task is not None:
        check_task_name(source, (attributes or {}).get("env_id"), task)
    reader = _Reader(fields, source, task, dtype)
    terminated, times = reader.flags("terminals"), _times(reader)
    if lengths is None:
        truncated, cuts = _truncations(reader, terminated, max_episode_steps, gaps, times)
        ends = terminated | truncated
        if not ends.any():
            hint = "" if "timeouts" in fields else ", or give max_episode_steps"
            problem = f"no episode ends in its {reader.num_rows} rows: mark the last row of each"
            raise DatasetError(source, f"{problem} in 'timeouts'{hint}.")
        ends[-1] = True
    else:
        total, positive = lengths.sum(), (lengths > 0).all()
        if "timeouts" not in fields or not positive or total != reader.num_rows:
            problem = (
                f"lengths must be positive, add up to the {reader.num_rows} rows, and come with "
                f"'timeouts', but add up to {total}."
            )
            raise DatasetError(source, problem)
        truncated, cuts = reader.flags("timeouts"), np.zeros_like(terminated)
        ends = np.zeros_like(terminated)
        ends[lengths.cumsum() - 1] = True
        if (inside := (terminated | truncated) & ~ends).any():
            problem = "ends the episode, but more steps follow."
            raise DatasetError(source, problem, "terminals", int(inside.argmax()))

    if times is not None:
        _check_times(source, times, ends)
    last_steps = np.flatnonzero(ends)
    steps = np.diff(last_steps, prepend=-1)
    check_limit(source, steps, max_episode_steps)
    cut = cuts[last_steps] | np.append(False, cuts[last_steps[:-1]])
    if CUTS in fields:
        cut |= reader.flags(CUTS)[last_steps]
    rows = memory_mapped_rows(reader.num_rows + len(last_steps), reader.row_fields(), directory)
    # The final observation of an episode is an additional row, so all later rows move by one.
    row_of = torch.arange(reader.num_rows)
    row_of[1:] += torch.from_numpy(ends[:-1].cumsum())
    for name, kept in {
        "observations": "observation",
        "actions": "action",
        "rewards": "reward",
    }.items():
        for start, values in reader.chunks(name):
            rows[kept][row_of[start : start + len(values)]] = values
    for name, flag in {"terminated": terminated, "truncated": truncated}.items():
        rows[name][row_of] = torch.from_numpy(flag).unsqueeze(-1)
    has_next = "next_observations" in fields
    if has_next:
        _place_next_observations(reader, rows["observation"], row_of, torch.from_numpy(ends))
    return Episodes(
        rows=rows,
        lengths=torch.from_numpy(steps),
        final_known=torch.full((len(last_steps),), has_next),
        cut=torch.from_numpy(cut),
        source=source,
        attributes=attributes or {},
        left_out=tuple(sorted(set(fields) - {*FIELDS, CUTS})),
    )


class _Reader:
    """The fields of one source; names, lengths and shapes are checked on construction."""

    def __init__(
        self,
        fields: Mapping[str, Any],
        source: str,
        task: TaskSpaces | None,
        dtype: torch.dtype | None,
    ) -> None:
        self.fields, self.source, self.task = fields, source, task
        for name in _REQUIRED:
            if name not in fields:
                found = ", ".join(sorted(map(str, fields))) or "nothing"
                raise DatasetError(source, f"is missing; there is {found}.", name)
        given = [name for name in (*FIELDS, CUTS) if name in fields]
        self.shapes = {name: self._shape(name) for name in given}
        self.num_rows = len(fields["observations"])
        self.dtypes = {
            name: kept_dtype(source, name, np.dtype(fields[name].dtype), dtype) for name in given
        }
        for name in given:
            self._check_shape(name)
        self.dtypes["next_observations"] = self.dtypes["observations"]

    def _shape(self, name: str) -> tuple[int, ...]:
        """Shape of one row."""
        shape = getattr(self.fields[name], "shape", None)
        if not shape:
            raise DatasetError(self.source, "is not an array with one row per transition.", name)
        row = tuple(shape[1:])
        # Discrete actions may be stored as a column, as rewards and flags.
        discrete = self.task is not None and self.task.action.shape == ()
        is_number = name in _NUMBERS or (name == "actions" and discrete)
        return () if row == (1,) and is_number else row

    def _check_shape(self, name: str) -> None:
        """Raises DatasetError if a field has the wrong number of rows, or rows of a wrong shape."""
        length, shape, observation = (
            len(self.fields[name]),
            self.shapes[name],
            self.shapes["observations"],
        )
        problem = None
        if self.num_rows == 0:
            problem = "has no rows."
        elif length != self.num_rows:
            problem = f"has {length} rows, but 'observations' has {self.num_rows}."
        elif name in _NUMBERS and shape != ():
            problem = f"one row has the shape {list(shape)}, but must be a number."
        elif name == "observations" and shape == ():
            problem = "one row is one number; give it [N, 1]."
        elif name == "next_observations" and shape != observation:
            problem = (
                f"one row has the shape {list(shape)}, but one of 'observations' has "
                f"{list(observation)}."
            )
        if problem:
            raise DatasetError(self.source, problem, name)
        if self.task is not None and name in ("observations", "actions"):
            space = self.task.observation if name == "observations" else self.task.action
            check_shape(self.source, name, shape, space, self.task)
            if name == "observations":
                check_bytes(self.source, self.dtypes[name], space, self.task)

    def row_fields(self) -> dict[str, tuple[tuple[int, ...], torch.dtype]]:
        """Shapes and dtypes of the rows of the episodes."""
        return {
            "observation": (self.shapes["observations"], self.dtypes["observations"]),
            "action": (self.shapes["actions"], self.dtypes["actions"]),
            "reward": ((1,), self.dtypes["rewards"]),
            "terminated": ((1,), torch.bool),
            "truncated": ((1,), torch.bool),
        }

    def flags(self, name: str) -> NDArray:
        """All values of a field of flags; bool [N]."""
        flags = np.empty(self.num_rows, dtype=bool)
        for part in self._parts(name):
            values = self._slice(name, part).reshape(-1)
            wrong = (values != 0) & (values != 1)
            if wrong.any():
                row = int(wrong.argmax())
                problem = f"is {values[row]}, but must be 0 or 1."
                raise DatasetError(self.source, problem, name, part.start + row)
            flags[part] = values
        return flags

    def chunks(self, name: str) -> Iterator[tuple[int, Tensor]]:
        """The chunks of a field, each with the index of its first row."""
        for part in self._parts(name):
            yield part.start, self.read(name, part.start, part.stop)

    def read(self, name: str, start: int, stop: int) -> Tensor:
        """Reads, checks and converts some rows; [n, *row]."""
        values = self._slice(name, slice(start, stop))
        check_finite(self.source, name, values, start, self.dtypes[name])
        shape = (1,) if name == "rewards" else self.shapes[name]
        values = values.reshape(len(values), *shape)
        if name == "actions" and self.task is not None:
            check_actions(self.source, values, self.task.action, start)
        return plain_tensor(values).to(self.dtypes[name])

    def _parts(self, name: str) -> Iterator[slice]:
        """The rows of a field in pieces of bounded size."""
        size = rows_per_chunk(self.fields[name].dtype.itemsize * math.prod(self.shapes[name]))
        for start in range(0, self.num_rows, size):
            yield slice(start, min(start + size, self.num_rows))

    def _slice(self, name: str, rows: slice) -> NDArray:
        with damage_named(self.source, "rows from here on cannot be read", name, rows.start):
            return np.asarray(self.fields[name][rows])


def _truncations(
    reader: _Reader,
    terminated: NDArray,
    max_episode_steps: int | None,
    gaps: Gaps,
    times: NDArray | None,
) -> tuple[NDArray, NDArray]:
    """Where episodes were truncated, and where that is only because of a gap; bool [N] each."""
    marked = "timeouts" in reader.fields
    truncated = reader.flags("timeouts") if marked else np.zeros_like(terminated)
    flagged = terminated | truncated
    jumps = pauses = np.zeros_like(terminated)
    if "next_observations" in reader.fields and (gaps == "cut" or not marked):
        jumps = _gaps(reader) & ~flagged
        truncated |= jumps  # without marks, this is where episodes end
    if times is not None and gaps == "cut":
        pauses = _pauses(times)[0] & ~flagged & ~jumps
    if max_episode_steps is not None and not marked:
        ends = np.flatnonzero(terminated | truncated)
        for before, last in pairwise([-1, *ends, reader.num_rows - 1]):
            truncated[before + max_episode_steps : last + 1 : max_episode_steps] = True
        truncated &= ~terminated
        pauses &= ~truncated
    return truncated | pauses, pauses | jumps & marked


def _times(reader: _Reader) -> NDArray | None:
    """The times of the steps, [N], if there are any."""
    if reader.fields.get(TIMESTAMPS) is None:
        return None
    with damage_named(reader.source, "cannot be read", TIMESTAMPS):
        times = np.asarray(reader.fields[TIMESTAMPS]).reshape(-1)
    if len(times) != reader.num_rows or times.dtype.kind not in "iuf":
        problem = f"must be {reader.num_rows} numbers, one for each row."
        raise DatasetError(reader.source, problem, TIMESTAMPS)
    return times


def _pauses(times: NDArray) -> tuple[NDArray, float]:
    """Where the next row comes too late for the next step, bool [N], and the usual interval."""
    intervals = np.diff(times.astype(np.float64))
    usual = float(np.median(intervals)) if len(intervals) else 0.0
    late = (intervals > 1.5 * usual) & (usual > 0)  # not where only the second is recorded
    return np.append(late, False), usual


def _check_times(source: str, times: NDArray, ends: NDArray) -> None:
    """Checks that the steps of an episode are in order, one period apart; ends bool [N]."""
    backwards = np.append(~(times[1:] >= times[:-1]), False)  # also where it is NaN
    pauses, usual = _pauses(times)
    for problem, wrong in {
        "sort the rows by time, or mark where episodes end": backwards,
        f'resample them to their usual interval, {usual:g}, or gaps="cut" truncates it': pauses,
    }.items():
        if (inside := wrong & ~ends).any():
            row = int(inside.argmax()) + 1
            problem = f"is {times[row]} after {times[row - 1]}, within an episode: {problem}."
            raise DatasetError(source, problem, TIMESTAMPS, row)


def _gaps(reader: _Reader) -> NDArray:
    """Where the next observation is not the observation of the next row; bool [N]."""
    gaps = np.zeros(reader.num_rows, dtype=bool)
    for start, following in reader.chunks("next_observations"):
        # The last row has no next row to compare with.
        after = reader.read("observations", start + 1, start + 1 + len(following))
        differs = (following[: len(after)] != after).flatten(1).any(1)
        gaps[start : start + len(after)] = differs.numpy()
    return gaps


def _place_next_observations(
    reader: _Reader, observations: Tensor, row_of: Tensor, ends: Tensor
) -> None:
    """Writes the final observations, and checks the others; row_of int64 [N], ends bool [N]."""
    for start, following in reader.chunks("next_observations"):
        part = slice(start, start + len(following))
        target, is_final = row_of[part] + 1, ends[part]
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
