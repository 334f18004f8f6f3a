"""Transitions that are collected in parts, one file per part, and joined into episodes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_tit.datasets.episodes import Episodes
from torchrl_tit.datasets.errors import DatasetError
from torchrl_tit.datasets.full_disks import new_hdf5
from torchrl_tit.datasets.joined_field import JoinedField
from torchrl_tit.datasets.optional import h5py
from torchrl_tit.datasets.stored import check_group, damage_named, open_hdf5
from torchrl_tit.datasets.transition_reader import FIELDS
from torchrl_tit.datasets.transitions import episodes_from_transitions
from torchrl_tit.files import whole_or_not_at_all


class TransitionParts:
    """A folder of numbered files of transitions, each written atomically.

    A part contains S streams of transitions, one from each environment of a batch, and each stream
    continues in the next part. So an episode can span many parts, and the parts written by a killed
    process are not lost.

    Args:
        folder: The folder of the files, which is created if missing.

    Example:
        >>> import tempfile
        >>> parts = TransitionParts(tempfile.mkdtemp())
        >>> for number in (1, 2):  # two streams, two steps
        ...     states, ends = np.zeros((2, 2, 3), np.float32), np.zeros((2, 2), bool)
        ...     parts.write(number, {
        ...         "observations": states, "actions": states, "rewards": np.ones((2, 2)),
        ...         "terminals": ends, "timeouts": ends, "next_observations": states,
        ...     })
        >>> parts.num_rows(), parts.episodes().lengths
        (8, tensor([4, 4]))
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder).absolute()
        self.folder.mkdir(parents=True, exist_ok=True)
        self._checked: set[int] = set()

    def numbers(self, last: int | None = None) -> list[int]:
        """Lists the parts.

        Args:
            last: Number of the last part to list; by default all are listed.

        Returns:
            The numbers of the parts in ascending order.
        """
        names = [path.stem for path in self.folder.glob("*.hdf5")]
        found = sorted(int(name) for name in names if name.isdecimal())
        return [number for number in found if last is None or number <= last]

    def write(self, number: int, fields: Mapping[str, NDArray]) -> None:
        """Writes a part.

        Args:
            number: The part's number, which determines the order of the parts.
            fields: All of D4RL's fields, by name: [S, T, ...] each, one row per transition.

        Raises:
            FileExistsError: If a part of that number exists already.
            OSError: If it cannot be written.
        """
        path = self._path(number)
        with whole_or_not_at_all(path) as hidden, new_hdf5(hidden, path) as (file, check):
            for name in FIELDS:
                array = np.ascontiguousarray(fields[name])
                file.create_dataset(name, data=array, chunks=True, compression="lzf")
                check()

    def read(self, number: int) -> dict[str, NDArray]:
        """Reads a part.

        Args:
            number: Its number.

        Returns:
            The fields as they were written.

        Raises:
            DatasetError: If it is damaged.
        """
        with self._open(number) as file, damage_named(str(self._path(number)), "cannot be read"):
            return {name: file[name][:] for name in FIELDS}

    def drop_after(self, number: int) -> None:
        """Removes the parts after a number, and unfinished files of killed processes.

        Args:
            number: Number of the last part to keep.
        """
        for path in self.folder.glob(".*.tmp"):
            path.unlink()
        for other in self.numbers():
            if other > number:
                self._path(other).unlink()

    def num_rows(self, last: int | None = None) -> int:
        """Counts transitions.

        Args:
            last: Number of the last part to count; by default all are counted.

        Returns:
            The number of transitions.
        """
        total = 0
        for number in self.numbers(last):
            with self._open(number) as file:
                total += file["rewards"].size
        return total

    def episodes(self, last: int | None = None, **settings: Any) -> Episodes:
        """Joins the parts, one stream after the other, without reading them all at once.

        An unfinished episode is truncated at the end of its stream, and where a part does not begin
        with the observation with which the previous part ended.

        Args:
            last: Number of the last part to join; by default all are joined.
            **settings: As for :func:`~torchrl_tit.datasets.transitions.episodes_from_transitions`.

        Returns:
            The episodes, with the dtypes of the files.

        Raises:
            DatasetError: If there are no parts, one is damaged, or their shapes differ.
        """
        numbers = self.numbers(last)
        if not numbers:
            raise DatasetError(str(self.folder), "contains no transitions.")
        fields: dict[str, Any] = {name: self._joined(numbers, name) for name in FIELDS}
        streams = self._shape(numbers[0], "rewards")[0]
        ends = fields["terminals"][:].reshape(streams, -1)
        timeouts = fields["timeouts"][:].reshape(streams, -1)
        timeouts[:, -1] |= ~ends[:, -1]
        fields["timeouts"] = timeouts.reshape(-1)
        return episodes_from_transitions(
            fields, source=str(self.folder), gaps="cut", **{"dtype": None, **settings}
        )

    def _joined(self, numbers: list[int], name: str) -> JoinedField:
        """All rows of a field, stream after stream; [S * T, ...]."""
        first = self._shape(numbers[0], name)

        def check(number: int, shape: tuple[int, ...]) -> None:
            if (shape[0], *shape[2:]) != (first[0], *first[2:]):
                raise DatasetError(
                    str(self._path(number)),
                    f"has the shape {list(shape)}, which does not fit that in "
                    f"{self._path(numbers[0]).name}, {list(first)}.",
                    name,
                )

        return JoinedField(name, numbers, self._open, check)

    def _shape(self, number: int, name: str) -> tuple[int, ...]:
        """Shape of a field of a part: streams, steps, and the shape of a row."""
        with self._open(number) as file:
            return file[name].shape

    def _open(self, number: int) -> h5py.File:
        path = self._path(number)
        file = open_hdf5(path)
        if number not in self._checked:
            check_group(str(path), file)
            for name in FIELDS:
                shape = getattr(file.get(name), "shape", ())
                if len(shape) < 2 or shape[:2] != file["observations"].shape[:2]:
                    problem = f"has the shape {list(shape)}, which must begin as all others do."
                    raise DatasetError(str(path), problem, name)
            self._checked.add(number)
        return file

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:012d}.hdf5"
