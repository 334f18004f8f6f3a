"""What RecurrentPPO reaches on MiniGrid-Memory is written as each run ends, and not run twice."""

import pytest
from gymnasium.spaces import Discrete

pytest.importorskip("minigrid")

from benchmarks import recurrent_ppo, sb3_returns
from benchmarks.measuring import read_rows


@pytest.fixture
def short(monkeypatch):
    for settings in recurrent_ppo.SETTINGS.values():
        monkeypatch.setitem(settings, "n_steps", 8)  # 128 steps in a batch
        monkeypatch.setitem(settings, "n_epochs", 1)
    monkeypatch.setattr(recurrent_ppo, "TOTAL_STEPS", 256)
    monkeypatch.setattr(recurrent_ppo, "EPISODES", 2)


@pytest.mark.parametrize("settings", ["default", "recipe"])
def test_a_row_a_run_and_none_twice(settings, short, tmp_path, monkeypatch, capsys):
    out = tmp_path / "new" / "recurrent.csv"
    words = ["--out", str(out), "--seeds", "0", "--settings", settings]
    recurrent_ppo.main(words)
    [row] = read_rows(out)
    assert list(row) == recurrent_ppo.COLUMNS
    assert (row["size"], row["seed"]) == ("7", "0")
    assert (row["total_steps"], row["settings"], row["steps"]) == ("256", settings, "256")
    assert row["steps_to_0.9"] == ""  # that takes a hundred episodes
    assert float(row["success"]) in (0, 1 / 2, 1)
    assert 0 <= float(row["return"]) <= 1
    assert float(row["steps_per_second"]) > 0
    assert float(row["processor_steps_per_second"]) > 0
    assert capsys.readouterr().out.startswith(f"7 0 256 {settings} ")
    monkeypatch.setattr(recurrent_ppo, "measure", lambda *_: pytest.fail("measured again"))
    recurrent_ppo.main(words)


def test_the_environment_is_that_of_the_recipes():
    env = recurrent_ppo.make_env(7)
    assert env.observation_space.shape == (24, 24, 3)
    assert env.action_space == Discrete(3)
    env.reset(seed=0)
    for _ in range(95):
        assert not any(env.step(0)[2:4])  # it turns
    assert env.step(0)[2:4] == (False, True)


def test_a_row_a_run(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sb3_returns, "EPISODES", 2)
    out = tmp_path / "new" / "sb3.csv"
    words = ["CartPole-v1", "--total-steps", "2048", "--out", str(out)]
    sb3_returns.main([*words, "--seeds", "0"])
    (row,) = read_rows(out)
    assert list(row) == sb3_returns.COLUMNS
    assert (row["env"], row["seed"], row["total_steps"]) == ("CartPole-v1", "0", "2048")
    assert 8 <= float(row["evaluation"]) <= 500
    assert 8 <= float(row["training_last_fifth"]) <= 500
    assert capsys.readouterr().out.startswith("CartPole-v1 0 2048 ")
