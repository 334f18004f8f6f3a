"""What Stable-Baselines3 reaches is written as each run ends, and not run twice."""

import csv

from benchmarks import sb3_returns


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_row_a_run(tmp_path, capsys):
    out = tmp_path / "new" / "sb3.csv"
    words = ["CartPole-v1", "--total-steps", "2048", "--episodes", "2", "--out", str(out)]
    sb3_returns.main([*words, "--seeds", "0"])
    (row,) = rows_of(out)
    assert list(row) == sb3_returns.COLUMNS
    assert (row["env"], row["seed"], row["total_steps"]) == ("CartPole-v1", "0", "2048")
    assert 8 <= float(row["evaluation"]) <= 500
    assert 8 <= float(row["training_last_fifth"]) <= 500
    assert capsys.readouterr().out.startswith("CartPole-v1 0 2048 ")


def test_what_is_there_is_not_run_again(tmp_path, monkeypatch):
    measured = []

    def measure(env, seed, total_steps, episodes):
        measured.append((env, seed))
        return [env, seed, total_steps, 1.0, 0.0, 1.0, "2"]

    monkeypatch.setattr(sb3_returns, "measure", measure)
    words = ["A-v0", "B-v0", "--out", str(tmp_path / "sb3.csv")]
    sb3_returns.main([*words, "--seeds", "0"])
    sb3_returns.main([*words, "--seeds", "0", "1"])
    assert measured == [("A-v0", 0), ("B-v0", 0), ("A-v0", 1), ("B-v0", 1)]
    assert len(rows_of(tmp_path / "sb3.csv")) == 4
