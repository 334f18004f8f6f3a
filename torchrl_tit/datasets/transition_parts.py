"""Transitions that are collected in parts, one file per part, and joined into episodes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchrl_tit.datasets.checks import DatasetError
from torchrl_tit.datasets.episodes import Episodes
from torchrl_tit.datasets.hdf5_files import JoinedField, find, h5py, new_hdf5, open_hdf5
from torchrl_tit.datasets.transitions import CUTS, FIELDS, episodes_from_transitions
from torchrl_tit.files import whole_or_not_at_all


class TransitionParts:
    """A folder of numbered files of transitions, each written atomically.

    A part contains S streams of transitions, one from each environment of a batch, and each stream
    continues in the next part. So an episode can span many parts, and the parts written by a killed
    process are not lost.

    Args:
        folder: the folder of the files, which is created if missing.

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
            last: number of the last part to list; by default all are listed.

        Returns:
            The numbers of the parts in ascending order.
        """
        names = [path.stem for path in self.folder.glob("*.hdf5")]
        found = sorted(int(name) for name in names if name.isdecimal())
        return [number for number in found if last is None or number <= last]

    def write(self, number: int, fields: Mapping[str, NDArray]) -> None:
        """Writes a part.

        Args:
            number: the part's number, which determines the order of the parts.
            fields: all of D4RL's fields, by name: [S, T, ...] each, one row per transition.

        Raises:
            FileExistsError: if a part of that number exists already.
            OSError: if it cannot be written.
        """
        path = self._path(number)
        with whole_or_not_at_all(path) as hidden, new_hdf5(hidden, path) as (file, check):
            for name in FIELDS:
                array = np.ascontiguousarray(fields[name])
                file.create_dataset(name, data=array, chunks=True, compression="lzf")
                check()

    def drop_after(self, number: int) -> None:
        """Removes the parts after a number, and unfinished files of killed processes.

        Args:
            number: number of the last part to keep.
        """
        for path in self.folder.glob(".*.tmp"):
            path.unlink()
        for other in self.numbers():
            if other > number:
                self._path(other).unlink()

    def num_rows(self, last: int | None = None) -> int:
        """Counts transitions.

        Args:
            last: number of the last part to count; by default all are counted.

        Returns:
            The number of transitions.
        """
        return sum(int(np.prod(self._shapes(number)["rewards"])) for number in self.numbers(last))

    def episodes(self, last: int | None = None, **settings: Any) -> Episodes:
        """Joins the parts, one stream after the other, without reading them all at once.

        An unfinished episode is cut off at the end of its stream, and where a part does not begin
        with the observation with which the previous part ended.

        Args:
            last: number of the last part to join; by default all are joined.
            **settings: as for :func:`~torchrl_tit.datasets.transitions.episodes_from_transitions`.

        Returns:
            The episodes, with the dtypes of the files.

        Raises:
            DatasetError: if there are no parts, one is damaged, or their shapes differ.
        """
        numbers = self.numbers(last)
        if not numbers:
            raise DatasetError(str(self.folder), "contains no transitions.")
        shapes = [self._shapes(number) for number in numbers]
        first = shapes[0]
        for number, shape in zip(numbers, shapes, strict=True):
            for name in FIELDS:
                if (shape[name][0], *shape[name][2:]) != (first[name][0], *first[name][2:]):
                    raise DatasetError(
                        str(self._path(number)),
                        f"has the shape {list(shape[name])}, which does not fit that in "
                        f"{self._path(numbers[0]).name}, {list(first[name])}.",
                        name,
                    )
        streams = first["rewards"][0]
        steps = [shape["rewards"][1] for shape in shapes]
        fields: dict[str, Any] = {}
        with self._open(numbers[0]) as file:
            for name in FIELDS:
                pieces = [
                    (count, partial(self._read, number, name, stream))
                    for stream in range(streams)
                    for number, count in zip(numbers, steps, strict=True)
                ]
                fields[name] = JoinedField(pieces, first[name][2:], file[name].dtype)
        ends, timeouts = (
            fields[name][:].reshape(streams, -1) for name in ("terminals", "timeouts")
        )
        cuts = np.zeros_like(timeouts)
        cuts[:, -1] = ~(ends | timeouts)[:, -1]
        fields |= {"timeouts": (timeouts | cuts).reshape(-1), CUTS: cuts.reshape(-1)}
        return episodes_from_transitions(
            fields, source=str(self.folder), gaps="cut", **{"dtype": None, **settings}
        )

    def _read(self, number: int, name: str, stream: int, start: int, stop: int) -> NDArray:
        """Reads some steps of a stream."""
        with self._open(number) as file:
            return file[name][stream, start:stop]

    def _shapes(self, number: int) -> dict[str, tuple[int, ...]]:
        """The shape of each field of a part, [S, T, ...]."""
        with self._open(number) as file:
            shapes = {name: getattr(file.get(name), "shape", ()) for name in FIELDS}
        for name, shape in shapes.items():
            if len(shape) < 2 or shape[:2] != shapes["observations"][:2]:
                problem = f"has the shape {list(shape)}, which must begin as all others do."
                raise DatasetError(str(self._path(number)), problem, name)
        return shapes

    def _open(self, number: int) -> h5py.File:
        path = self._path(number)
        file = open_hdf5(path)
        if number not in self._checked:
            for name in FIELDS:
                find(str(path), file, name)
            self._checked.add(number)
        return file

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:012d}.hdf5"
