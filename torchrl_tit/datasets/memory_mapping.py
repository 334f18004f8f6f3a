"""Memory-mapped tensors, for data larger than memory."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping
from math import prod
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor


def memory_mapped_rows(
    num_rows: int,
    fields: Mapping[str, tuple[tuple[int, ...], torch.dtype]],
    directory: str | os.PathLike[str] | None = None,
) -> TensorDict:
    """Creates rows of zeros in memory-mapped files.

    The files are unlinked once they are mapped (where the system allows that), so nothing remains
    of them when the tensors are freed or the program ends in any way.

    Args:
        num_rows: Number R of rows.
        fields: The shape of one row of each field, and its dtype.
        directory: Folder for the files; by default the system's folder for temporary files, which
            may be small.

    Returns:
        Tensors [R, *shape] by name.

    Raises:
        OSError: If the disk is full, or the folder cannot be written.

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
