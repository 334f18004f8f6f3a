"""Transitions in the making: a file for each piece of work, and episodes of all of them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from torchrl_tit.datasets.episodes import Episodes
from torchrl_tit.datasets.errors import DatasetError
from torchrl_tit.datasets.joined_field import JoinedField
from torchrl_tit.datasets.transition_reader import FIELDS
from torchrl_tit.datasets.transitions import episodes_from_transitions
from torchrl_tit.files import whole_or_not_at_all


class TransitionParts:
    """A folder of numbered files with transitions, each written whole or not at all.

    A part holds S streams of transitions side by side, as environments that are stepped together
    give them, and each stream goes on in the next part. So an episode can reach over many parts,
    and what a killed process had written is still there.

    Args:
        folder: Where the files are; made where missing.

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

    def numbers(self, last: int | None = None) -> list[int]:
        """Lists the parts.

        Args:
            last: Leaves out those that come after this number.

        Returns:
            Their numbers, the smallest first.
        """
        found = sorted(int(path.stem) for path in self.folder.glob("[0-9]*.hdf5"))
        return [number for number in found if last is None or number <= last]

    def write(self, number: int, fields: Mapping[str, NDArray]) -> None:
        """Writes a part.

        Args:
            number: What it comes behind the others by.
            fields: All of D4RL's fields, by name: [S, T, ...] each, with a row a transition.

        Raises:
            FileExistsError: If there is one of that number already.
            OSError: If it cannot be written.
        """
        with whole_or_not_at_all(self._path(number)) as hidden, h5py.File(hidden, "w") as file:
            for name in FIELDS:
                array = np.ascontiguousarray(fields[name])
                file.create_dataset(name, data=array, chunks=True, compression="lzf")

    def read(self, number: int) -> dict[str, NDArray]:
        """Reads a part.

        Args:
            number: Its number.

        Returns:
            What was written.

        Raises:
            DatasetError: If it is damaged.
        """
        with self._open(number) as file:
            return {name: file[name][:] for name in FIELDS}

    def drop_after(self, number: int) -> None:
        """Removes the parts behind a number, and what a killed process left half-written.

        Args:
            number: Of the last part that stays.
        """
        for path in self.folder.glob(".*.tmp"):
            path.unlink()
        for other in self.numbers():
            if other > number:
                self._path(other).unlink()

    def num_rows(self, last: int | None = None) -> int:
        """Counts transitions.

        Args:
            last: Leaves out the parts that come after this number.

        Returns:
            How many there are.
        """
        total = 0
        for number in self.numbers(last):
            with self._open(number) as file:
                total += file["rewards"].size
        return total

    def episodes(self, last: int | None = None, **settings: Any) -> Episodes:
        """Puts the parts together, one stream after the other, without reading them all at once.

        An episode that a stream leaves unfinished, at its end or because the next part begins with
        another observation than the one before ended in, counts as cut off there.

        Args:
            last: Leaves out the parts that come after this number.
            **settings: As for :func:`~torchrl_tit.datasets.transitions.episodes_from_transitions`.

        Returns:
            The episodes, in the dtypes that were written.

        Raises:
            DatasetError: If there are none, a part is damaged, or the parts do not fit each other.
        """
        numbers = self.numbers(last)
        if not numbers:
            raise DatasetError(str(self.folder), "holds no transitions.")
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
        """All rows of a field, stream by stream; [S * T, ...]."""
        first = self._shape(numbers[0], name)

        def check(number: int, shape: tuple[int, ...]) -> None:
            if (shape[0], *shape[2:]) != (first[0], *first[2:]):
                raise DatasetError(
                    str(self._path(number)),
                    f"has the shape {list(shape)}, which does not go on with that of "
                    f"{self._path(numbers[0]).name}, {list(first)}.",
                    name,
                )

        return JoinedField(name, numbers, self._open, check)

    def _shape(self, number: int, name: str) -> tuple[int, ...]:
        """Streams of a part, steps of each, and the shape of a row."""
        with self._open(number) as file:
            return file[name].shape

    def _open(self, number: int) -> h5py.File:
        path = self._path(number)
        try:
            return h5py.File(path, "r")
        except OSError as error:
            raise DatasetError(str(path), f"is not a whole HDF5 file ({error}).") from error

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:012d}.hdf5"
