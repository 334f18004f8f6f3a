"""What metrics say in words: the same in the reports and in the documents."""

from pathlib import Path

import pytest

from recipes.core import registry
from recipes.core.algorithm import make_algorithm
from recipes.core.recipe import Recipe
from recipes.core.registry import get_recipe
from recipes.tools.results.metric_words import known_columns, limit, to_markdown, words_of

ROOT = Path(__file__).parents[3]
assert registry.RECIPES  # every algorithm is registered
ALGORITHMS = sorted(
    name for name, kind in Recipe.registered.items() if kind.__module__.startswith("recipes.")
)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_column_is_described(algorithm):
    recipe = next(r for r in registry.RECIPES.values() if r.algorithm == algorithm)
    columns = [*make_algorithm(recipe).columns]
    if algorithm == "ppo":  # which depend on the recipe
        columns.append("loss_contrastive")
    for column in ("steps_per_second", "return_mean", *columns):
        assert words_of(algorithm, column).what, f"{column} of {algorithm} in metrics.csv"
        assert column in known_columns(algorithm)


def test_the_documents_have_the_same_words():
    page = ROOT / "docs" / "reference" / "metrics.md"  # the site adds the other algorithms
    assert to_markdown("ppo") in page.read_text()


def test_limits():
    recipe = get_recipe("ppo/cartpole/mlp")
    assert limit(words_of("ppo", "gradient_norm").high, recipe) == pytest.approx(5)
    assert limit(words_of("ppo", "kl_approx").high, recipe) == 0.02
    assert limit(words_of("ppo", "entropy").high, recipe) is None
    assert limit("10 * no_field", recipe) is None


def test_columns_that_are_not_known():
    assert words_of("ppo", "mine").what == ""
    assert words_of("dt", "return_-20").what == "mean return of the evaluation that aims for -20"
    assert words_of("dt", "return_scale").what == ""
