"""Runs on memory tasks end early where they are solved, and go on where they were stopped."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import memory_tasks
from benchmarks.measuring import read_rows
from benchmarks.memory_pictures import main
from benchmarks.memory_tasks import EPISODES, Successes
from recipes.core.recipe_json import recipe_to_json
from recipes.core.registry import find_recipe, get_recipe
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
    assert capsys.readouterr().out.startswith(f"{NAME} 0 ")
    monkeypatch.setattr(memory_tasks, "measure", lambda *_: pytest.fail("measured again"))
    memory_tasks.main(words)


def test_training_ends_where_the_task_is_solved(short, tmp_path, monkeypatch):
    monkeypatch.setattr(memory_tasks, "EPISODES", 20)
    words = [NAME, "--seeds", "0", "--threshold", "-2", "--out", str(tmp_path)]
    memory_tasks.main(words)  # all returns are at least -1
    [row] = read_rows(tmp_path / "runs.csv")
    assert (row["steps"], row["success"]) == ("256", "1.0")
    assert row["steps_to_0.9"] == ""  # that takes a hundred episodes


def test_each_seed_starts_with_the_weights_of_its_run_on_another_task(short, tmp_path):
    words = [NAME, "--seeds", "0", "--out"]
    memory_tasks.main([*words, str(tmp_path / "first")])
    memory_tasks.main(
        [*words, str(tmp_path / "next"), "--init-from", str(tmp_path / "first" / NAME)]
    )
    first, then = (Run.open(tmp_path / name / NAME / "seed-0") for name in ("first", "next"))
    start, trained = then.load_initial_weights(), first.load_trained()[1]["networks"]
    assert start
    assert start.keys() <= trained.keys()
    for name, weight in start.items():
        assert torch.equal(weight, trained[name])
    assert not first.initial_weights


def test_when_nine_in_ten_are_reached(tmp_path):
    successes = Successes(tmp_path / "successes.csv", 0, 0.0)
    # Over the last three batches: 70, 80, 89 and 90 %.
    successes.batches = [(1, 40, 20), (2, 40, 30), (3, 40, 34), (4, 40, 32), (5, 40, 41 - 1)]
    assert successes.reached() is None
    successes.batches.append((6, 40, 36))
    assert successes.reached() == 6
    assert EPISODES == 500


SOON, LATER = [(100, 50), (200, 100)], [(100, 50), (200, 100), (400, 0)]
"""Step and successes of 100 episodes each."""
ROWS = """recipe,seed,weights,steps,steps_to_0.9,success,return
ppo/tmaze-50/lstm,0,9,100,,0.4,0.4
ppo/tmaze-50/lstm,1,9,100,,0.6,0.6
ppo/tmaze-10/lstm,0,9,100,,1.0,1.0
ppo/memory-s7/lstm,0,9,100,,0.7,0.7
ppo/tmaze-10/enhanced-tit,0,9,100,,0.9,0.9
"""


@pytest.fixture
def make_run(tmp_path):
    def make(name, seed, batches):
        folder = tmp_path / name / f"seed-{seed}"
        folder.mkdir(parents=True)
        (folder / "recipe.json").write_text(recipe_to_json(get_recipe(name)))
        rows = "".join(f"{step},100,{right}\n" for step, right in batches)
        (folder / "successes.csv").write_text("step,episodes,successes\n" + rows)
        return folder

    return make


def drawn(axes):
    return {str(line.get_label()): np.asarray(line.get_data()) for line in axes.lines}


def test_the_command(make_run, tmp_path, capsys):
    out, rows = tmp_path / "a.png", tmp_path / "runs.csv"
    rows.write_text(ROWS.splitlines()[0])
    main(["curves", str(make_run("ppo/memory-s7/lstm", 0, SOON)), "--out", str(out)])
    assert out.read_bytes().startswith(b"\x89PNG")
    for what, path, said in [
        ("curves", tmp_path / "nothing", "holds no run folder"),
        ("curves", make_run("ppo/memory-s9/lstm", 1, []), "has fewer than a hundred episodes"),
        ("lengths", rows, "has no run on a T-Maze"),
    ]:
        with pytest.raises(SystemExit):
            main([what, str(path), "--out", str(tmp_path / "none.png")])
        assert said in capsys.readouterr().err
    assert not (tmp_path / "none.png").exists()
