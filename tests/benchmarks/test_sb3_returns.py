"""What Stable-Baselines3 reaches is written as each run ends, and not run twice."""

from benchmarks import sb3_returns
from benchmarks.measuring import read_rows


def test_a_row_a_run(tmp_path, capsys):
    out = tmp_path / "new" / "sb3.csv"
    words = ["CartPole-v1", "--total-steps", "2048", "--episodes", "2", "--out", str(out)]
    sb3_returns.main([*words, "--seeds", "0"])
    (row,) = read_rows(out)
    assert list(row) == sb3_returns.COLUMNS
    assert (row["env"], row["seed"], row["total_steps"]) == ("CartPole-v1", "0", "2048")
    assert 8 <= float(row["evaluation"]) <= 500
    assert 8 <= float(row["training_last_fifth"]) <= 500
    assert capsys.readouterr().out.startswith("CartPole-v1 0 2048 ")
