"""Files larger than the memory, and disks that are full."""

import multiprocessing
import resource
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from tests.processes import files_of_at_most
from torchrl_tit.datasets import (
    HistoryStorage,
    SequenceStorage,
    TransitionParts,
    episodes_from_arrays,
    load_episodes,
    make_replay_buffer,
    write_hdf5,
    write_minari,
)
from torchrl_tit.datasets.episodes import memory_mapped_rows

ROWS, WIDTH = 200_000, 100  # 80 MB of observations, and as much of the next ones
LIMIT = 64 * 2**20


def read(path: Path, output: Path) -> None:
    status = Path("/proc/self/status").read_text().splitlines()
    data = 1024 * next(int(line.split()[1]) for line in status if line.startswith("VmData"))
    resource.setrlimit(resource.RLIMIT_DATA, (data + LIMIT,) * 2)
    with pytest.raises(RuntimeError):  # the limit holds
        torch.ones(LIMIT // 4 + LIMIT // 16)
    episodes = load_episodes(path)
    mean, _, _ = episodes.observation_statistics()
    batch = make_replay_buffer(HistoryStorage(episodes, 4), 256).sample()
    make_replay_buffer(SequenceStorage(episodes, 20), 64).sample()
    assert (batch["history"][:, -1, 0] + 1 == batch["next", "history"][:, -1, 0]).all()
    output.write_text(f"{episodes.num_transitions} {float(mean[0])}")


@pytest.mark.skipif(sys.platform != "linux", reason="the limit is Linux's")
def test_a_file_larger_than_the_memory(tmp_path: Path) -> None:
    path, output = tmp_path / "large.hdf5", tmp_path / "output"
    numbers = np.arange(ROWS, dtype=np.float32)
    with h5py.File(path, "w") as file:
        for name, first in (("observations", 0), ("next_observations", 1)):
            dataset = file.create_dataset(name, (ROWS, WIDTH), np.float32)
            for start in range(0, ROWS, 50_000):
                part = numbers[start : start + 50_000, None] + first
                dataset[start : start + 50_000] = np.broadcast_to(part, (50_000, WIDTH))
        file["actions"] = np.zeros((ROWS, 1), np.float32)
        file["rewards"] = np.ones(ROWS, np.float32)
        file["terminals"] = np.zeros(ROWS, bool)
        file["timeouts"] = np.arange(ROWS) % 1000 == 999

    process = multiprocessing.Process(target=read, args=(path, output))
    process.start()
    process.join()

    assert process.exitcode == 0
    assert output.read_text().split() == [str(ROWS), str((ROWS - 1) / 2)]


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
EPISODES = episodes_from_arrays(**{name: array[0] for name, array in FIELDS.items()})


@pytest.mark.parametrize("size", [0, 100_000])
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


def test_memory_mapped_rows(tmp_path: Path) -> None:
    fields = {"a": ((2,), torch.float32), "b": ((), torch.bool)}
    rows = memory_mapped_rows(10, fields, tmp_path)
    rows["a"][3] = 1
    assert rows["a"].sum() == 2
    assert not rows["b"].any()
    with pytest.raises(OSError, match="missing \\(No such file or directory\\): choose a folder"):
        memory_mapped_rows(10, {}, tmp_path / "missing")
    with (
        files_of_at_most(1000),
        pytest.raises(OSError, match=f"rows of 9000 bytes .* into {tmp_path} .* choose a folder"),
    ):
        memory_mapped_rows(1000, fields, tmp_path)
    if sys.platform != "win32":
        assert list(tmp_path.iterdir()) == []
