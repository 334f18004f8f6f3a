"""Runs of the same settings are put together; what their metrics say in words."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from docs.tools import reference
from recipes.core import registry
from recipes.core.algorithm import make_algorithm
from recipes.core.recipe import Recipe
from recipes.core.recipe_json import recipe_to_json
from recipes.core.registry import get_recipe
from recipes.core.run import Run
from recipes.ppo import PPO
from recipes.tools.results.experiments import find_runs, group_runs
from recipes.tools.results.metric_words import known_columns, limit, words_of
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


def test_agents_made_of_runs_are_no_runs(tmp_path):
    for name in ("run", "agent"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "recipe.json").write_text(recipe_to_json(RECIPE))
    (tmp_path / "agent" / "agent.json").write_text("{}")
    assert [run.folder.name for run in find_runs([tmp_path])] == ["run"]
    with pytest.raises(ValueError, match="holds no run folder"):
        find_runs([tmp_path / "agent"])


def test_changes_are_those_from_the_recipe_of_that_name(tmp_path):
    changed = replace(get_recipe("ppo/breakout/resnet"), backbone=nature_cnn(4), seed=3)
    (found,) = group_runs([Run(tmp_path, changed)])
    assert found.name == "ppo/breakout/resnet"
    assert found.changes == "backbone.history.torso nature-cnn"


ROOT = Path(__file__).parents[3]
assert registry.RECIPES  # every algorithm is registered
ALGORITHMS = sorted(
    name for name, kind in Recipe.registered.items() if kind.__module__.startswith("recipes.")
)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_column_is_described(algorithm):
    recipes = (r for r in registry.RECIPES.values() if r.algorithm == algorithm)
    recipe = next(r for r in recipes if getattr(r, "dataset", True))  # not one for any data
    made = make_algorithm(recipe)
    columns = [*made.columns, *(f"held_out_{name}" for name in getattr(made, "measures", ()))]
    for column in ("steps_per_second", "return_mean", *columns):
        assert words_of(algorithm, column).what, f"{column} of {algorithm} in metrics.csv"
        assert column in known_columns(algorithm)


def test_the_documents_have_the_same_words():
    page = ROOT / "docs" / "reference" / "metrics.md"  # the site adds the other algorithms
    assert reference.metrics_of("ppo") in page.read_text()


def test_limits():
    recipe = get_recipe("ppo/cartpole/mlp")
    assert limit(words_of("ppo", "gradient_norm").high, recipe) == pytest.approx(5)
    assert limit(words_of("ppo", "kl_approx").high, recipe) == 0.03
    assert limit(words_of("ppo", "entropy").high, recipe) is None
    assert limit("10 * no_field", recipe) is None
