"""Episodes, stored one after the other, each with its final observation, possibly on disk."""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import prod
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_tit.datasets.checks import DatasetError
from torchrl_tit.settings.checks import checked_arguments
from torchrl_tit.settings.numbers import Inside, Seed

Unfinished = Literal["keep", "drop"]

CHUNK_BYTES = 4 * 2**20  # bytes read, checked and converted at a time


@dataclass(frozen=True, eq=False)
class Episodes:
    """A data set as a flat stream of rows: an episode of T steps is T + 1 rows.

    Row t of an episode is its step t: the observation, the action taken, and the reward and flags
    that followed. Its last row is the final observation, with zeros in the other fields. So each
    observation is stored once, and the next observation of a row is that of the following row.

    Args:
        rows: [R] with "observation" [R, *obs], "action" [R, *action], and "reward", "terminated"
            and "truncated" [R, 1].
        lengths: number of steps of each episode; int64 [E], all at least 1.
        final_known: whether the final observation of each episode is known (otherwise it is zeros);
            bool [E].
        cut: whether each episode ends or begins at a gap in the data, so that its return says
            nothing; bool [E].
        source: name of the source, for error messages.
        attributes: the source's metadata, as strings and numbers.
        left_out: names of the source's fields that were not read.

    Example:
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> episodes = episodes_from_arrays(
        ...     observations=np.arange(5.0).reshape(5, 1),
        ...     actions=np.zeros((5, 1)),
        ...     rewards=np.ones(5),
        ...     terminals=np.array([False, False, True, False, True]),
        ... )
        >>> episodes.lengths, episodes.returns
        (tensor([3, 2]), tensor([3., 2.], dtype=torch.float64))
        >>> episodes.rows["observation"].flatten()
        tensor([0., 1., 2., 0., 3., 4., 0.])
    """

    rows: TensorDictBase
    lengths: Tensor
    final_known: Tensor
    cut: Tensor
    source: str = "the data"
    attributes: Mapping[str, Any] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()

    @property
    def num_transitions(self) -> int:
        """Number of steps of all episodes."""
        return int(self.lengths.sum())

    @property
    def first_rows(self) -> Tensor:
        """Row of each episode's first step; int64 [E]."""
        return (self.lengths + 1).cumsum(0) - self.lengths - 1

    @property
    def last_rows(self) -> Tensor:
        """Row of each episode's last step; int64 [E]."""
        return (self.lengths + 1).cumsum(0) - 2

    @property
    def final_rows(self) -> Tensor:
        """Row of each final observation, or of the one before it if it is unknown; int64 [E]."""
        return self.last_rows + self.final_known

    @property
    def step_rows(self) -> Tensor:
        """Row of each step, in order: all rows but those of final observations; int64 [N]."""
        shifts = torch.arange(len(self.lengths), device=self.lengths.device)
        steps = torch.arange(self.num_transitions, device=self.lengths.device)
        return steps + shifts.repeat_interleave(self.lengths)

    @property
    def terminated(self) -> Tensor:
        """Whether each episode ended in a terminal state; bool [E]."""
        return self.rows["terminated"][self.last_rows].squeeze(-1)

    @property
    def truncated(self) -> Tensor:
        """Whether each episode was truncated, by a time limit for example; bool [E]."""
        return self.rows["truncated"][self.last_rows].squeeze(-1)

    @property
    def returns(self) -> Tensor:
        """Undiscounted return of each episode; float64 [E]."""
        rewards = self.rows["reward"].squeeze(-1).cpu().double().numpy()
        return torch.from_numpy(np.add.reduceat(rewards, self.first_rows.cpu().numpy()))

    @property
    def finished(self) -> Tensor:
        """Whether each episode was terminated or truncated; bool [E]."""
        return self.terminated | self.truncated

    @property
    def is_whole(self) -> Tensor:
        """Whether each episode is finished and not cut at a gap; bool [E]."""
        return self.finished & ~self.cut

    @property
    def whole(self) -> Tensor:
        """Indices of the episodes of which :attr:`is_whole` is true; int64 [M], on the CPU.

        Raises:
            DatasetError: if there are none.
        """
        whole = self.is_whole.nonzero().squeeze(-1).cpu()
        if not len(whole):
            problem = "has no whole episode, only unfinished ones or parts of others: record more."
            raise DatasetError(self.source, problem)
        return whole

    def to(self, device: torch.device | str) -> Episodes:
        """Copies the data to a device; windows are then gathered there.

        Args:
            device: the device, such as "cuda".

        Returns:
            The same episodes on the device.
        """
        return replace(
            self,
            rows=self.rows.to(device),
            lengths=self.lengths.to(device),
            final_known=self.final_known.to(device),
            cut=self.cut.to(device),
        )

    def observation_statistics(
        self,
        samples: Callable[[Tensor], Tensor] = lambda observations: observations,
        *,
        unfinished: Unfinished = "drop",
    ) -> tuple[Tensor, Tensor, int]:
        """Computes the mean and standard deviation of the observations.

        Args:
            samples: what is counted of observations [N, *obs], [M, *sample]: see
                :meth:`torchrl_tit.frames.FrameEncoder.samples`.
            unfinished: whether observations of unfinished episodes count ("keep") or not ("drop").

        Returns:
            Mean and population standard deviation, float32 [*sample] each, and the number of
            samples, for :meth:`torchrl_tit.frames.NormalizedFrames.set_statistics`. The deviation
            of a constant entry is 1, for an array with a warning, so that it is not amplified if it
            changes later.

        Raises:
            DatasetError: if there are none, because no episode is finished or all sets are empty.
        """
        kept = self.finished | (unfinished == "keep")
        count, total = 0, torch.zeros((), dtype=torch.float64)
        for chunk in map(samples, self._observations(kept)):
            count, total = count + len(chunk), total + chunk.double().sum(0)
        if not count:
            problem = "has no observations of finished episodes, so they have no mean: record more."
            raise DatasetError(self.source, problem)
        mean = total / count
        squares = torch.zeros_like(mean)
        for chunk in map(samples, self._observations(kept)):
            squares += chunk.double().sub_(mean).square_().sum(0)
        std = (squares / count).sqrt().float()
        varies = std > 1e-7 * mean.abs()  # less is rounding
        if mean.ndim == 1 and (constant := (~varies).nonzero().flatten().tolist()):
            warnings.warn(
                f"{self.source}: entries {', '.join(map(str, constant))} of the observations are "
                "constant, so they are not divided by their deviation",
                stacklevel=2,
            )
        return mean.float(), std.where(varies, 1.0), count

    def _observations(self, kept: Tensor) -> Iterator[Tensor]:
        """The observations at the steps of some episodes, bool [E], in chunks."""
        chosen = kept.repeat_interleave(self.lengths + 1)  # [R]
        chosen[self.last_rows + 1] = False  # final observations are not steps
        observations = self.rows["observation"]
        size = rows_per_chunk(observations[0].numel() * 8)  # as float64
        for start in range(0, len(observations), size):
            yield observations[start : start + size][chosen[start : start + size]]


def select_episodes(episodes: Episodes, index: Tensor) -> Episodes:
    """Copies some of the episodes.

    Args:
        episodes: the data.
        index: indices of the episodes, in the order of the result; int64 [M].

    Returns:
        The selected episodes.

    Raises:
        ValueError: if there is no such episode.

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
        cut=episodes.cut[index],
    )


@checked_arguments
def split_episodes(episodes: Episodes, fraction: Inside, seed: Seed) -> tuple[Episodes, Episodes]:
    """Holds some of the finished episodes out.

    If fewer than two are finished, the last part of one is held out, with a warning.

    Args:
        episodes: the data.
        fraction: share of the finished episodes to hold out, above 0 and below 1; at least one
            episode is held out, and at least one is not.
        seed: seed of the choice.

    Returns:
        The episodes to learn from, unfinished ones among them, and those that are held out.

    Raises:
        ValueError: if ``fraction`` or ``seed`` is out of its bounds.
        DatasetError: if fewer than two episodes are finished, and that one has a single step.

    Example:
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> states, ends = torch.arange(40.0).view(40, 1), torch.arange(40) % 4 == 3
        >>> episodes = episodes_from_arrays(states, states, torch.ones(40), ends)
        >>> rest, held_out = split_episodes(episodes, 0.2, seed=0)
        >>> len(rest.lengths), len(held_out.lengths)
        (8, 2)
    """
    finished = episodes.finished.nonzero().squeeze(-1)
    if len(finished) < 2:
        return _split_single(episodes, fraction)
    generator = torch.Generator().manual_seed(seed)
    order = finished[torch.randperm(len(finished), generator=generator)]
    count = min(max(1, round(fraction * len(finished))), len(finished) - 1)
    chosen = torch.zeros_like(episodes.finished)
    chosen[order[:count]] = True
    rest, held_out = (select_episodes(episodes, x.nonzero().squeeze(-1)) for x in (~chosen, chosen))
    return rest, held_out


def _split_single(episodes: Episodes, fraction: float) -> tuple[Episodes, Episodes]:
    """Cuts the first finished episode, or the first one, in two; the others are before it."""
    number = int(episodes.finished.int().argmax())
    others = [i for i in range(len(episodes.lengths)) if i != number]
    single = select_episodes(episodes, torch.tensor([number]))
    length = int(single.lengths)
    place = length - max(1, round(fraction * length))
    if place < 1:
        raise DatasetError(
            episodes.source,
            "has a single finished episode of one step, of which nothing can be held out: record "
            "more.",
        )
    warnings.warn(
        f"{episodes.source} has a single finished episode: its last {length - place} of {length} "
        "steps are held out",
        stacklevel=3,
    )
    before, after = single.rows[: place + 1].clone(), single.rows[place:]
    for name, values in before.items():
        if name != "observation":  # the last row is the final observation
            values[-1] = 0
    before["truncated"][-2] = True
    single = replace(single, cut=torch.tensor([True]))
    first = replace(
        single, rows=before, lengths=torch.tensor([place]), final_known=torch.tensor([True])
    )
    last = replace(single, rows=after, lengths=torch.tensor([length - place]))
    rest = [select_episodes(episodes, torch.tensor(others))] if others else []
    return join_episodes([*rest, first]), last


def join_episodes(parts: Sequence[Episodes]) -> Episodes:
    """Concatenates data sets.

    Args:
        parts: data sets with the same fields, at least one; the result has the source and the
            attributes of the first.

    Returns:
        The episodes of all of them.

    Raises:
        ValueError: if there are none, or the shapes or dtypes of their fields differ.

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
        for name, first in parts[0].rows.items():
            other = part.rows[name]
            if (other.shape[1:], other.dtype) != (first.shape[1:], first.dtype):
                raise ValueError(
                    f"{part.source}: field {name!r} has the shape {list(other.shape[1:])} and "
                    f"{other.dtype}, but in {parts[0].source} {list(first.shape[1:])} and "
                    f"{first.dtype}: data sets of one task and dtype can be joined"
                )
    return replace(
        parts[0],
        rows=torch.cat([part.rows for part in parts]),
        lengths=torch.cat([part.lengths for part in parts]),
        final_known=torch.cat([part.final_known for part in parts]),
        cut=torch.cat([part.cut for part in parts]),
    )


def check_final_observations(episodes: Episodes) -> None:
    """Checks that the episodes can be written with their final observations.

    Args:
        episodes: the data.

    Raises:
        DatasetError: if the final observation of a truncated episode is unknown.

    Example:
        >>> from torchrl_tit.datasets import episodes_from_arrays
        >>> states = np.zeros((2, 3))
        >>> episodes = episodes_from_arrays(states, states, np.ones(2), [0, 0], [0, 1])
        >>> check_final_observations(episodes)
        Traceback (most recent call last):
        ...
        torchrl_tit.datasets.checks.DatasetError: the data: episode 0 was truncated and its...
    """
    unknown = ~episodes.final_known & ~episodes.terminated
    if unknown.any():
        number = int(unknown.int().argmax())
        kind = "was truncated" if episodes.truncated[number] else "is unfinished"
        raise DatasetError(
            episodes.source,
            f"episode {number} {kind} and its final observation is "
            f"unknown, because there are no 'next_observations': it cannot be written.",
        )


def rows_per_chunk(bytes_per_row: int) -> int:
    """Returns the number of rows to process at a time, at least 1.

    Args:
        bytes_per_row: size of one row.

    Example:
        >>> rows_per_chunk(1024)
        4096
    """
    return max(1, CHUNK_BYTES // max(1, bytes_per_row))


def memory_mapped_rows(
    num_rows: int,
    fields: Mapping[str, tuple[tuple[int, ...], torch.dtype]],
    directory: str | os.PathLike[str] | None = None,
) -> TensorDict:
    """Creates rows of zeros in memory-mapped files.

    The files are unlinked once they are mapped (where the system allows that), so nothing remains
    of them when the tensors are freed or the program ends in any way.

    Args:
        num_rows: number R of rows.
        fields: the shape of one row of each field, and its dtype.
        directory: folder for the files; by default the system's folder for temporary files, which
            may be small.

    Returns:
        Tensors [R, *shape] by name.

    Raises:
        OSError: if the disk is full, or the folder cannot be written.

    Example:
        >>> memory_mapped_rows(5, {"reward": ((1,), torch.float32)})["reward"].shape
        torch.Size([5, 1])
    """
    size = num_rows * sum(prod(shape) * dtype.itemsize for shape, dtype in fields.values())
    try:
        with tempfile.TemporaryDirectory(
            prefix="torchrl-tit-", dir=directory, ignore_cleanup_errors=True
        ) as folder:
            tensors = {
                name: _map(Path(folder, name), (num_rows, *shape), dtype)
                for name, (shape, dtype) in fields.items()
            }
    except OSError as error:
        raise OSError(
            f"{num_rows} rows of {size} bytes in all cannot be written into "
            f"{directory or tempfile.gettempdir()} ({error.strerror or error}): choose a folder "
            "with room for them as directory"
        ) from error
    return TensorDict(tensors, [num_rows])


def _map(file: Path, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    size = prod(shape)
    if hasattr(os, "posix_fallocate"):
        # Allocated now, because a disk that fills up later would kill the program without an error.
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT)
        try:
            os.posix_fallocate(descriptor, 0, max(1, size * dtype.itemsize))
        finally:
            os.close(descriptor)
    return torch.from_file(str(file), shared=True, size=size, dtype=dtype).view(shape)
