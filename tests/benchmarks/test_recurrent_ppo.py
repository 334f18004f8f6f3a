"""What RecurrentPPO reaches on MiniGrid-Memory is written as each run ends, and not run twice."""

import pytest
import torch
from gymnasium.spaces import Box, Discrete

pytest.importorskip("minigrid")

from benchmarks import memory_tasks, recurrent_ppo, sb3_returns
from benchmarks.measuring import read_rows


@pytest.fixture
def short(monkeypatch):
    for settings in recurrent_ppo.SETTINGS.values():
        monkeypatch.setitem(settings, "n_steps", 8)  # 128 steps in a batch
        monkeypatch.setitem(settings, "n_epochs", 1)


@pytest.mark.parametrize("settings", ["default", "recipe"])
def test_a_row_a_run_and_none_twice(settings, short, tmp_path, monkeypatch, capsys):
    out = tmp_path / "new" / "recurrent.csv"
    words = ["--total-steps", "256", "--episodes", "2", "--out", str(out), "--seeds", "0"]
    words += ["--settings", settings]
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


def test_training_ends_where_the_task_is_solved(short, monkeypatch):
    evaluate_policy = recurrent_ppo.evaluate_policy
    shares = iter([0.5, 1.0])
    seeds = []

    def evaluated(agent, envs, episodes, **settings):
        """Returns what the last evaluation really gives; before it, half fail, and then none."""
        seeds.append(envs._seeds[0])
        returns, lengths = evaluate_policy(agent, envs, episodes, **settings)
        if (share := next(shares, None)) is not None:
            returns = [1.0 if i < share * episodes else -2.0 for i in range(episodes)]
        return returns, lengths

    monkeypatch.setattr(recurrent_ppo, "evaluate_policy", evaluated)
    monkeypatch.setattr(memory_tasks, "EPISODES", 4)
    monkeypatch.setattr(memory_tasks, "WINDOW", 4)
    monkeypatch.setattr(recurrent_ppo, "THRESHOLD", -1.0)  # all returns are at least 0
    batches = []

    class Progress(recurrent_ppo.Progress):
        def _on_training_end(self):
            batches.extend(self.successes.batches)

    monkeypatch.setattr(recurrent_ppo, "Progress", Progress)
    row = recurrent_ppo.measure(7, 0, 5_000, "default", 2)
    cells = dict(zip(recurrent_ppo.COLUMNS, row, strict=True))
    assert [step for step, _, _ in batches] == [128 * (i + 1) for i in range(len(batches))]
    assert batches[-1][0] < 5_000
    # Four episodes succeed, but not the most likely actions; then four others, and these.
    [fourth] = [i for i in range(len(batches)) if sum(n for _, n, _ in batches[:i]) < 4][-1:]
    assert cells["steps_to_0.9"] == batches[fourth][0]
    assert sum(episodes for _, episodes, _ in batches[fourth + 1 : -1]) < 4
    assert len(batches) > fourth + 1
    assert seeds == [memory_tasks.VALIDATION_SEED] * 2 + [recurrent_ppo.EVALUATION_SEED]
    assert cells["steps"] == batches[-1][0]
    assert cells["success"] == 1


def test_pixels_are_normalized_by_channel():
    space = Box(0, 1, (3, 24, 24))
    pixels = torch.rand(64, 3, 24, 24) * torch.tensor([1.0, 0.2, 0.5])[:, None, None]
    first = recurrent_ppo.Tiles(space, normalize=True).layers[0](pixels)
    assert first.mean((0, 2, 3)).abs().max() < 1e-4
    assert (first.std((0, 2, 3)) - 1).abs().max() < 1e-2
    assert torch.equal(recurrent_ppo.Tiles(space).layers[0](pixels), pixels)


def test_the_environment_is_that_of_the_recipes():
    env = recurrent_ppo.make_env(7)
    assert env.observation_space.shape == (24, 24, 3)
    assert env.action_space == Discrete(3)
    env.reset(seed=0)
    for _ in range(95):
        assert not any(env.step(0)[2:4])  # it turns
    assert env.step(0)[2:4] == (False, True)


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
