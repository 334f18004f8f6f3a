"""Which runs `compare` draws as one curve."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from recipes.cli import main
from recipes.core.registry import get_recipe
from recipes.core.run import Run
from tests.recipes.commands import fails

NAME = "ppo/cartpole/mlp"


@pytest.fixture
def begun(tmp_path, monkeypatch):
    """Begins runs, in each of which an episode has ended."""
    monkeypatch.chdir(tmp_path)

    def begin(folder, recipe=NAME, **fields):
        Run.create(tmp_path / folder, replace(get_recipe(recipe), **fields))
        (tmp_path / folder / "metrics.csv").write_text("step,time,return_mean\n1,0,1.0\n2,1,3.0\n")
        return folder

    return begin


@pytest.fixture
def drawn(monkeypatch):
    """Runs by the name of their curve, after `compare`."""

    def compare(*folders):
        found = {}

        def plot(experiments, picture, title):
            found.update({experiment.label: experiment.runs for experiment in experiments})
            return []

        monkeypatch.setattr("recipes.tools.results.plot.plot_comparison", plot)
        main(["compare", *folders])
        return {name: [str(run.folder) for run in runs] for name, runs in found.items()}

    return compare


def test_seeds_of_a_recipe_are_one_curve(begun, drawn):
    begun("a"), begun("b", seed=1), begun("c", "ppo/cartpole/d2rl")
    assert drawn("a", "b", "c", "./a") == {NAME: ["a", "b"], "ppo/cartpole/d2rl": ["c"]}


def test_the_logs_of_a_sweep_are_passed_over(begun, drawn, capsys):
    begun("seed-0")
    Path("seed-0.log").touch()
    assert drawn("seed-0", "seed-0.log") == {NAME: ["seed-0"]}
    assert "seed-0.log is not a run folder, but a log" in fails(capsys, "compare", "seed-0.log")


def test_it_says_how_far_runs_of_different_lengths_were_trained(begun, drawn, capsys):
    for folder, steps in (("a", 1024), ("b", 2048)):
        begun(folder, total_steps=steps, seed=steps)
        evaluation = {"env": "CartPole-v1", "steps": steps, "seed": 0, "weights": "last"}
        evaluation |= {"mean": 1.0, "std": 0.0, "episodes": 1, "returns": [1.0]}
        (Path(folder) / "evaluation.json").write_text(json.dumps(evaluation))
    drawn("a")
    assert "runs were evaluated" not in capsys.readouterr().err
    drawn("a", "b")
    assert "the runs were evaluated after 1024, 2048 steps" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ("ppo/acrobot/mlp", "a and b do not go together: their tasks are CartPole-v1 and"),
        ("discrete-cql/cartpole-mixed/mlp", "environment steps and gradient steps do not share"),
    ],
)
def test_what_does_not_go_together(other, message, begun, capsys):
    begun("a"), begun("b", other)
    assert message in fails(capsys, "compare", "a", "b")


def test_runs_in_which_no_episode_has_ended(begun, tmp_path, capsys):
    begun("a")
    (tmp_path / "a" / "metrics.csv").write_text("step,time,return_mean\n1,0,nan\n")
    Run.create(tmp_path / "b", get_recipe("ppo/cartpole/d2rl"))
    assert "no episode has ended in a, b" in fails(capsys, "compare", "a", "b")
    assert not (tmp_path / "comparison.png").exists()
