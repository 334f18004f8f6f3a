"""What d3rlpy reaches on a data set is written as each run ends, and not run twice."""

import h5py
import pytest

pytest.importorskip("d3rlpy")

from benchmarks import d3rlpy_returns
from benchmarks.measuring import read_rows
from tests.datasets.rollouts import roll, write


@pytest.mark.parametrize("algorithm", d3rlpy_returns.ALGORITHMS)
def test_a_row_a_run_and_none_twice(algorithm, tmp_path, monkeypatch):
    monkeypatch.setattr(d3rlpy_returns, "EPISODES", 2)
    monkeypatch.setattr(d3rlpy_returns, "INTERVAL", 4)
    data, out = write(tmp_path / "rolled.hdf5", roll()), tmp_path / "new" / "d3rlpy.csv"
    with h5py.File(data, "a") as file:
        file.attrs["env_id"] = "Hopper-v5"
    words = [str(data), "--out", str(out), "--algorithms", algorithm, "--seeds", "0"]
    d3rlpy_returns.main([*words, "--updates", "8"])
    (row,) = read_rows(out)
    assert list(row) == d3rlpy_returns.COLUMNS
    assert list(row.values())[:4] == ["rolled", algorithm, "0", "8"]
    assert 0 < float(row["last"]) <= float(row["best"]) < 1000
    monkeypatch.setattr(d3rlpy_returns, "measure", lambda *_: pytest.fail("measured again"))
    d3rlpy_returns.main([*words, "--updates", "8"])
