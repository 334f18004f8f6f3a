"""Runs on memory tasks end early where they are solved, and go on where they were stopped."""

from dataclasses import replace
from typing import Any

import pytest

from benchmarks import memory_tasks
from benchmarks.measuring import read_rows
from benchmarks.memory_tasks import EPISODES, Successes
from recipes.core import runner
from recipes.core.registry import find_recipe
from recipes.core.run import Run

NAME = "ppo/tmaze-10/frames-4"
SHORT: dict[str, Any] = {
    "env_settings": ("corridor_length=10",),  # episodes of 11 steps
    "total_steps": 512,
    "num_envs": 2,
    "steps_per_batch": 128,
    "minibatch_size": 64,
    "sequence_length": None,
    "epochs": 1,
    "checkpoint_interval": 128,
    "evaluation_episodes": 3,
}


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(
        memory_tasks, "find_recipe", lambda name: replace(find_recipe(name), **SHORT)
    )


def test_a_row_a_run_and_none_twice(short, tmp_path, monkeypatch, capsys):
    words = [NAME, "--seeds", "0", "--out", str(tmp_path)]
    memory_tasks.main(words)
    [row] = read_rows(tmp_path / "runs.csv")
    assert (row["recipe"], row["seed"], row["steps"]) == (NAME, "0", "512")
    assert float(row["success"]) in (0, 1 / 3, 2 / 3, 1)
    batches = read_rows(tmp_path / NAME / "seed-0" / "successes.csv")
    assert [int(batch["step"]) for batch in batches] == [128, 256, 384, 512]
    assert sum(int(batch["episodes"]) for batch in batches) >= 44  # of 11 steps
    printed = capsys.readouterr().out
    assert printed.startswith(f"{NAME} 0 ")
    assert f"| {NAME} | {row['weights']} | 1 | " in printed
    monkeypatch.setattr(memory_tasks, "measure", lambda *_: pytest.fail("measured again"))
    memory_tasks.main(words)


def test_training_ends_where_the_task_is_solved(short, tmp_path, monkeypatch):
    monkeypatch.setattr(memory_tasks, "EPISODES", 20)
    words = [NAME, "--seeds", "0", "--threshold", "-2", "--out", str(tmp_path)]
    memory_tasks.main(words)  # all returns are at least -1
    [row] = read_rows(tmp_path / "runs.csv")
    assert (row["steps"], row["success"]) == ("256", "1.0")
    assert row["steps_to_0.9"] == ""  # that takes a hundred episodes


def test_training_goes_on_if_the_most_likely_actions_fail(short, tmp_path, monkeypatch):
    monkeypatch.setattr(memory_tasks, "EPISODES", 20)
    shares, evaluate = iter([0.97, 0.98]), runner.evaluate

    def checked(run, recipe=None):
        evaluation = evaluate(run, recipe)
        if recipe is not None:
            assert recipe.evaluation_seed == memory_tasks.VALIDATION_SEED
            right = round(100 * next(shares))
            evaluation["returns"] = [1.0] * right + [-3.0] * (100 - right)
        return evaluation

    monkeypatch.setattr(runner, "evaluate", checked)
    memory_tasks.main([NAME, "--seeds", "0", "--threshold", "-2", "--out", str(tmp_path)])
    [row] = read_rows(tmp_path / "runs.csv")
    assert (row["steps"], row["success"]) == ("512", "1.0")  # twice as many episodes
    batches = read_rows(tmp_path / NAME / "seed-0" / "successes.csv")
    assert [int(batch["step"]) for batch in batches] == [128, 256, 384, 512]


def test_a_stopped_run_goes_on(short, tmp_path):
    recipe = memory_tasks.find_recipe(NAME)

    class Stopped(Exception):
        pass

    class Stop(Successes):
        def saved(self, step):
            if step == 256:
                raise Stopped

    with Run.create(tmp_path / "run", recipe) as run, pytest.raises(Stopped):
        runner.train(recipe, run, [Stop(run.folder / "successes.csv", 0, 0.0)])
    memory_tasks.measure(recipe, tmp_path / "run", 0.0)
    memory_tasks.measure(recipe, tmp_path / "whole", 0.0)
    stopped, whole = (read_rows(tmp_path / name / "successes.csv") for name in ("run", "whole"))
    assert [row["step"] for row in stopped] == [row["step"] for row in whole]
    assert stopped[:2] == whole[:2]  # then with new episodes


def test_when_nine_in_ten_are_reached(tmp_path):
    successes = Successes(tmp_path / "successes.csv", 0, 0.0)
    # Over the last three batches: 70, 80, 89 and 90 %.
    successes.batches = [(1, 40, 20), (2, 40, 30), (3, 40, 34), (4, 40, 32), (5, 40, 41 - 1)]
    assert successes.reached() is None
    successes.batches.append((6, 40, 36))
    assert successes.reached() == 6
    assert EPISODES == 500


def test_the_table_has_a_row_a_recipe():
    columns = memory_tasks.COLUMNS
    rows = [
        ["a", "0", "9", "500", "1000", "1.0", "0.5"],
        ["b", "0", "7", "500", "", "0.4", "0.2"],
        ["a", "1", "9", "500", "3000", "0.8", "0.5"],
        ["b", "1", "7", "500", "2000", "0.4", "0.2"],
    ]
    table = memory_tasks.to_markdown([dict(zip(columns, row, strict=True)) for row in rows])
    assert table.splitlines()[2:] == [
        "| a | 9 | 2 | 0.900 [0.800, 1.000] | 0.500 [0.500, 0.500] | 2 [1, 3] |",
        "| b | 7 | 2 | 0.400 [0.400, 0.400] | 0.200 [0.200, 0.200] | 2, not by 1 of 2 |",
    ]
