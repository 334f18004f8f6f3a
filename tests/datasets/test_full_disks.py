"""A disk that is full while data are written: one line, and nothing is left."""

import contextlib
import resource
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from torchrl_tit.datasets import TransitionParts, episodes_from_arrays, write_hdf5, write_minari
from torchrl_tit.datasets.episodes import memory_mapped_rows

NOISE = np.random.default_rng(0).normal(size=(1, 4000, 8)).astype(np.float32)
ENDS = np.arange(4000)[None] % 100 == 99
FIELDS = {
    "observations": NOISE,
    "actions": NOISE[..., :2],
    "rewards": NOISE[..., 0],
    "terminals": ENDS,
    "timeouts": ENDS & False,
    "next_observations": np.roll(NOISE, -1, axis=1),
}


@contextlib.contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """No file grows beyond a number of bytes, as on a disk that is full then."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


EPISODES = episodes_from_arrays(**{name: array[0] for name, array in FIELDS.items()})


@pytest.mark.parametrize("size", [0, 3000, 100_000])
@pytest.mark.parametrize(
    "write",
    [
        lambda folder: write_hdf5(EPISODES, folder / "a-v0"),
        lambda folder: write_minari(EPISODES, folder / "a-v0"),
        lambda folder: TransitionParts(folder).write(1, FIELDS),
    ],
    ids=["HDF5", "Minari", "parts"],
)
def test_it_is_said_once_and_nothing_is_left(
    write: Callable[[Path], None], size: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with (
        pytest.raises(OSError, match=r"cannot be written: .*[Tt]oo large") as error,
        files_of_at_most(size),
    ):
        write(tmp_path)
    assert "\n" not in str(error.value)
    assert str(tmp_path) in str(error.value)
    assert capfd.readouterr().err == ""
    assert list(tmp_path.iterdir()) == []


def test_rows_without_room_name_the_folder(tmp_path: Path) -> None:
    with (
        files_of_at_most(1000),
        pytest.raises(OSError, match=f"rows of 4000 bytes .* into {tmp_path} .* choose a folder"),
    ):
        memory_mapped_rows(1000, {"reward": ((1,), torch.float32)}, tmp_path)
    assert list(tmp_path.iterdir()) == []
