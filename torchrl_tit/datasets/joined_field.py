"""Reads one array from many files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from torchrl_tit.datasets.optional import h5py


class JoinedField:
    """Joins a field of numbered parts, [S, T, ...] each, into [S * T, ...], stream after stream.

    Slicing opens the parts it needs, one at a time. HDF5's own virtual data sets would keep all
    parts open, but a process can only have about a thousand open files.

    Args:
        name: The field.
        numbers: The parts.
        open_part: Opens the file of a part.
        check: Called with each part's number and shape [S, T, ...]; raises if the shape does not
            fit.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> folder = Path(tempfile.mkdtemp())
        >>> for number in range(2):  # two streams, three steps
        ...     with h5py.File(folder / str(number), "w") as file:
        ...         file["rewards"] = np.arange(6).reshape(2, 3) + 10 * number
        >>> field = JoinedField("rewards", [0, 1], lambda n: h5py.File(folder / str(n), "r"))
        >>> field.shape, field[1:9].tolist()
        ((12,), [1, 2, 10, 11, 12, 3, 4, 5])
    """

    def __init__(
        self,
        name: str,
        numbers: Sequence[int],
        open_part: Callable[[int], h5py.File],
        check: Callable[[int, tuple[int, ...]], None] = lambda number, shape: None,
    ) -> None:
        self._name, self._numbers, self._open = name, numbers, open_part
        steps = []
        for number in numbers:
            with open_part(number) as file:
                part = file[name]
                check(number, part.shape)
                steps.append(part.shape[1])
                if number == numbers[0]:
                    self._streams, row, self.dtype = part.shape[0], part.shape[2:], part.dtype
        self._bounds = [
            0,
            *accumulate(steps),
        ]  # steps before each part, and the total
        self.shape = (self._streams * self._bounds[-1], *row)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice) -> NDArray:
        start, stop, _ = rows.indices(len(self))
        values = np.empty((max(0, stop - start), *self.shape[1:]), self.dtype)
        total = self._bounds[-1]
        streams = range(start // total, (stop - 1) // total + 1)
        for number, (before, after) in zip(self._numbers, pairwise(self._bounds), strict=True):
            spans = []  # per stream: first row in the part, and the requested rows in it
            for stream in streams:
                origin = stream * total + before
                low, high = max(start, origin), min(stop, origin + after - before)
                if low < high:
                    spans.append((stream, origin, low, high))
            if spans:
                with self._open(number) as file:
                    part = file[self._name]
                    for stream, origin, low, high in spans:
                        values[low - start : high - start] = part[
                            stream, low - origin : high - origin
                        ]
        return values
