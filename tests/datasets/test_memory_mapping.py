"""Files larger than the memory that a process may have."""

import multiprocessing
import resource
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from torchrl_tit.datasets import (
    HistoryStorage,
    SequenceStorage,
    load_episodes,
    make_replay_buffer,
)
from torchrl_tit.datasets.episodes import memory_mapped_rows

ROWS, WIDTH = 200_000, 100  # 80 MB of observations, and as much of the next ones


def read(path: Path, limit: int, output: Path) -> None:
    status = Path("/proc/self/status").read_text().splitlines()
    data = 1024 * next(int(line.split()[1]) for line in status if line.startswith("VmData"))
    resource.setrlimit(resource.RLIMIT_DATA, (data + limit,) * 2)
    with pytest.raises(RuntimeError):  # the limit holds
        torch.ones(limit // 4 + limit // 16)
    episodes = load_episodes(path)
    mean, _ = episodes.observation_statistics()
    batch = make_replay_buffer(HistoryStorage(episodes, 4), 256).sample()
    make_replay_buffer(SequenceStorage(episodes, 20), 64).sample()
    assert (batch["history"][:, -1, 0] + 1 == batch["next", "history"][:, -1, 0]).all()
    output.write_text(f"{episodes.num_transitions} {float(mean[0])}")


@pytest.mark.skipif(sys.platform != "linux", reason="the limit is Linux's")
def test_a_file_larger_than_the_memory(tmp_path: Path) -> None:
    path = tmp_path / "large.hdf5"
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

    limit = 64 * 2**20  # the observations alone are 80 MB, the file is 160 MB
    output = tmp_path / "output"
    process = multiprocessing.Process(target=read, args=(path, limit, output))
    process.start()
    process.join()

    assert process.exitcode == 0
    assert output.read_text().split() == [str(ROWS), str((ROWS - 1) / 2)]


def test_nothing_stays_in_the_folder(tmp_path: Path) -> None:
    rows = memory_mapped_rows(10, {"a": ((2,), torch.float32), "b": ((), torch.bool)}, tmp_path)
    rows["a"][3] = 1
    assert rows["a"].sum() == 2
    assert not rows["b"].any()
    if sys.platform != "win32":
        assert list(tmp_path.iterdir()) == []


def test_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="missing \\(No such file or directory\\): choose a folder"):
        memory_mapped_rows(10, {}, tmp_path / "missing")
