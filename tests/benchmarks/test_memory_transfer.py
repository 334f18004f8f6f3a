"""Agents play mazes that they were not trained in."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks import memory_tasks, memory_transfer
from benchmarks.measuring import read_rows
from recipes.core.registry import get_recipe
from tests.recipes.small import train

NAME = "ppo/memory-s7/frames-4"
SHORT: dict[str, Any] = {
    "total_steps": 64,
    "num_envs": 2,
    "steps_per_batch": 64,
    "minibatch_size": 32,
    "sequence_length": None,
    "epochs": 1,
}


def test_a_row_for_each_maze_and_none_twice(tmp_path, monkeypatch, capsys):
    run = train(replace(get_recipe(NAME), seed=3, **SHORT), tmp_path / "run")
    table = tmp_path / "transfer.csv"
    words = [str(run.folder), "--mazes", "S7", "S17Random", "--episodes", "2", "--out", str(table)]
    memory_transfer.main(words)
    rows = read_rows(table)
    assert [row["maze"] for row in rows] == ["S7", "S17Random"]
    for row in rows:
        assert (row["recipe"], row["seed"], row["episodes"]) == (NAME, "3", "2")
        assert float(row["success"]) in (0, 0.5, 1)
        assert (float(row["return"]) > 0) == (float(row["success"]) > 0)
    monkeypatch.setattr(
        memory_transfer.runner, "evaluate", lambda *_: pytest.fail("measured again")
    )
    memory_transfer.main(words)


@pytest.mark.parametrize(
    ("program", "problem"),
    [
        (memory_tasks.main, "unknown recipe 'absent'"),
        (memory_transfer.main, "absent is not a run folder"),
    ],
)
def test_a_mistake_gives_one_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    program: Callable[[list[str]], None],
    problem: str,
) -> None:
    with pytest.raises(SystemExit):
        program(["absent", "--out", str(tmp_path / "out")])
    assert f"error: {problem}" in capsys.readouterr().err
