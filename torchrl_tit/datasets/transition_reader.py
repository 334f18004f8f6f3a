"""Reads and checks fields in D4RL's layout, in chunks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchrl_tit.datasets.checks import (
    FLAGS,
    check_actions,
    check_finite,
    kept_dtype,
    plain_tensor,
)
from torchrl_tit.datasets.episodes import rows_per_chunk
from torchrl_tit.datasets.errors import DatasetError
from torchrl_tit.datasets.stored import damage_named
from torchrl_tit.datasets.tasks import TaskSpaces, check_shape

FIELDS = ("observations", "actions", "rewards", "terminals", "timeouts", "next_observations")
_REQUIRED = FIELDS[:4]


class TransitionReader:
    """The fields of one source; names, lengths and shapes are checked on construction.

    Args:
        fields: Arrays by D4RL's names: NumPy arrays or HDF5 data sets, which are read in slices.
        source: Name of the source, for error messages.
        task: The task whose shapes and action bounds the data must have; not checked if None.
        dtype: The dtype for floats; None keeps that of each field.

    Raises:
        DatasetError: If a field is missing, empty, or of the wrong length, shape or dtype.

    Example:
        >>> arrays = {name: np.zeros((3, 1)) for name in FIELDS}
        >>> [(start, len(chunk)) for start, chunk in TransitionReader(arrays).chunks("rewards")]
        [(0, 3)]
    """

    def __init__(
        self,
        fields: Mapping[str, Any],
        source: str = "the data",
        task: TaskSpaces | None = None,
        dtype: torch.dtype | None = torch.float32,
    ) -> None:
        self.fields, self.source, self.task, self.dtype = fields, source, task, dtype
        for name in _REQUIRED:
            if name not in fields:
                found = ", ".join(sorted(map(str, fields))) or "nothing"
                raise DatasetError(source, f"is missing; there is {found}.", name)
        self.shapes = {name: self._shape(name) for name in FIELDS if name in fields}
        self.num_rows = len(fields["observations"])
        if self.num_rows == 0:
            raise DatasetError(source, "has no rows.", "observations")
        self._check_sizes()

    def _shape(self, name: str) -> tuple[int, ...]:
        """Shape of one row."""
        shape = getattr(self.fields[name], "shape", None)
        if not shape:
            raise DatasetError(self.source, "is not an array with one row per transition.", name)
        row = tuple(shape[1:])
        numbers = {*FLAGS, "rewards"}
        if self.task is not None and self.task.action.shape == ():
            numbers.add("actions")  # discrete, possibly stored as a column
        return () if row == (1,) and name in numbers else row

    def _check_sizes(self) -> None:
        for name, shape in self.shapes.items():
            if (length := len(self.fields[name])) != self.num_rows:
                raise DatasetError(
                    self.source, f"has {length} rows, but 'observations' has {self.num_rows}.", name
                )
            if name in (*FLAGS, "rewards") and shape != ():
                raise DatasetError(
                    self.source,
                    f"one row has the shape {list(shape)}, but must be a number.",
                    name,
                )
            self.torch_dtype(name)
        if self.shapes["observations"] == ():
            raise DatasetError(
                self.source, "one row is one number; give it [N, 1].", "observations"
            )
        if (
            self.shapes.get("next_observations", self.shapes["observations"])
            != (self.shapes["observations"])
        ):
            raise DatasetError(
                self.source,
                f"one row has the shape {list(self.shapes['next_observations'])}, but one of "
                f"'observations' has {list(self.shapes['observations'])}.",
                "next_observations",
            )
        if self.task is not None:
            spaces = {"observations": self.task.observation, "actions": self.task.action}
            for name, space in spaces.items():
                check_shape(self.source, name, self.shapes[name], space, self.task)

    def torch_dtype(self, name: str) -> torch.dtype:
        """The dtype in which a field is stored."""
        return kept_dtype(self.source, name, np.dtype(self.fields[name].dtype), self.dtype)

    def row_fields(self) -> dict[str, tuple[tuple[int, ...], torch.dtype]]:
        """Shapes and dtypes of the rows of the episodes."""
        return {
            "observation": (self.shapes["observations"], self.torch_dtype("observations")),
            "action": (self.shapes["actions"], self.torch_dtype("actions")),
            "reward": ((1,), self.torch_dtype("rewards")),
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
                raise DatasetError(
                    self.source, f"is {values[row]}, but must be 0 or 1.", name, part.start + row
                )
            flags[part] = values
        return flags

    def chunks(self, name: str) -> Iterator[tuple[int, Tensor]]:
        """The chunks of a field, each with the index of its first row."""
        for part in self._parts(name):
            yield part.start, self.read(name, part.start, part.stop)

    def _parts(self, name: str) -> Iterator[slice]:
        """The rows of a field in pieces of bounded size."""
        size = rows_per_chunk(self.fields[name].dtype.itemsize * math.prod(self.shapes[name]))
        for start in range(0, self.num_rows, size):
            yield slice(start, min(start + size, self.num_rows))

    def read(self, name: str, start: int, stop: int) -> Tensor:
        """Reads, checks and converts some rows; [n, *row]."""
        values = self._slice(name, slice(start, stop))
        dtype = self.torch_dtype("observations" if name == "next_observations" else name)
        check_finite(self.source, name, values, start, dtype)
        if name == "actions" and self.task is not None:
            check_actions(self.source, values, self.task.action, start)
        shape = (1,) if name == "rewards" else self.shapes[name]
        return plain_tensor(values).reshape(len(values), *shape).to(dtype)

    def _slice(self, name: str, rows: slice) -> NDArray:
        with damage_named(self.source, "rows from here on cannot be read", name, rows.start):
            return np.asarray(self.fields[name][rows])
