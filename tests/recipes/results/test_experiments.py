"""Runs of the same settings are put together."""

from dataclasses import replace

import pytest

from recipes.core.registry import get_recipe
from recipes.core.run import Run
from recipes.ppo import PPO
from recipes.tools.results.experiments import group_runs
from torchrl_tit.settings.networks import mlp, nature_cnn

RECIPE = PPO(name="a", env="CartPole-v1", backbone=mlp())


def test_whatever_their_seed_and_machine(tmp_path):
    one = Run(tmp_path / "0", RECIPE)
    other = Run(tmp_path / "1", replace(RECIPE, seed=1, device="cpu", threads=2, compile="on"))
    third = Run(tmp_path / "2", replace(RECIPE, learning_rate=0.1))
    assert [(e.label, e.runs) for e in group_runs([one, third, other])] == [
        ("a", (one, other)),
        ("a (learning_rate 0.1)", (third,)),
    ]


def test_changes_are_those_from_the_recipe_of_that_name(tmp_path):
    changed = replace(get_recipe("ppo/breakout/resnet"), backbone=nature_cnn(4), seed=3)
    (found,) = group_runs([Run(tmp_path, changed)])
    assert found.name == "ppo/breakout/resnet"
    assert found.changes == "backbone.history.torso nature-cnn"


def test_without_a_name(tmp_path):
    (found,) = group_runs([Run(tmp_path / "own", replace(RECIPE, name=""))])
    assert found.label == str(tmp_path / "own")


def test_the_same_run_twice(tmp_path):
    runs = [Run(tmp_path / "0", RECIPE), Run(tmp_path / "3", RECIPE)]
    with pytest.raises(ValueError, match=r"0 and .*3 are the same run: a with seed 0; name one"):
        group_runs(runs)
