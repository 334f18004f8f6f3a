"""The two ways to read windows agree, and their times are reported."""

import json

import pytest

from benchmarks import window_tables


def test_reports_a_ratio_for_each_k(tmp_path, capsys):
    window_tables.main(["--num-frames", "2", "8", "--seconds", "0", "--out", str(tmp_path)])
    numbers = json.loads((tmp_path / "window_tables.json").read_text())
    names = [f"{name}, K = {k}" for name in ("Enhanced_TIT", "GTrXL") for k in (2, 8)]
    assert set(names) < set(numbers)
    assert all(min(numbers[name]["ratios"]) > 0 for name in names)
    assert "| GTrXL | 8 |" in capsys.readouterr().out


def test_ways_that_differ_are_refused(tmp_path, monkeypatch):
    read = window_tables.read
    monkeypatch.setattr(
        window_tables, "read", lambda network, in_table, x: read(network, in_table, x) + in_table
    )
    with pytest.raises(AssertionError, match="not close"):
        window_tables.main(["--num-frames", "8", "--seconds", "0", "--out", str(tmp_path)])
    assert not (tmp_path / "window_tables.json").exists()
