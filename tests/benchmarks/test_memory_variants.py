"""Variants of memory recipes are recipes, and differ from the named ones where they say so."""

from dataclasses import fields
from pathlib import Path

import pytest

pytest.importorskip("minigrid")

from benchmarks import memory_variants
from recipes.core.algorithm import make_algorithm
from recipes.core.registry import find_recipe, get_recipe

LARGER = ("frames-32", "tiles-of-28-pixels")
FIELDS = {
    "shuffled-windows": {"sequence_length"},
    "tiles-of-28-pixels": {"backbone", "wrappers"},
    "own-limit-seven-actions": {"env_settings", "wrappers"},
}


@pytest.mark.parametrize("name", memory_variants.RECIPES)
def test_a_variant(name):
    recipe = find_recipe(f"{Path(memory_variants.__file__)}:{name}")
    task, _, word = name.rpartition("/")
    named = get_recipe(f"{task}/enhanced-tit")
    changed = {
        field.name
        for field in fields(recipe)
        if getattr(recipe, field.name) != getattr(named, field.name)
    }
    assert changed == {"name"} | FIELDS.get(word, {"backbone"})
    algorithm = make_algorithm(recipe)
    algorithm.check()
    history = algorithm.make_env(1, seed=0).reset()["history"]
    assert history.shape[:2] == (1, recipe.backbone.num_frames)
    weights = sum(weight.numel() for weight in algorithm.policy.parameters())
    expected = sum(weight.numel() for weight in make_algorithm(named).policy.parameters())
    assert 0.75 * expected < weights
    assert (weights < 1.25 * expected) == (word not in LARGER)
