"""Variants of memory recipes are recipes, and differ in the network alone."""

from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("minigrid")

from benchmarks import memory_variants
from recipes.algorithm import make_algorithm
from recipes.registry import find_recipe, get_recipe


@pytest.mark.parametrize("name", memory_variants.RECIPES)
def test_a_variant(name):
    recipe = find_recipe(f"{Path(memory_variants.__file__)}:{name}")
    named = get_recipe(f"{name.rpartition('/')[0]}/enhanced-tit")
    assert recipe.name == name
    assert recipe.backbone != named.backbone
    assert replace(recipe, name=named.name, backbone=named.backbone) == named
    algorithm = make_algorithm(recipe)
    algorithm.check()
    history = algorithm.make_env(1, seed=0).reset()["history"]
    assert history.shape[:2] == (1, recipe.backbone.num_frames)
    if name != "ppo/memory-s7/frames-32":
        weights = sum(weight.numel() for weight in algorithm.policy.parameters())
        expected = sum(p.numel() for p in make_algorithm(named).policy.parameters())
        assert 0.75 < weights / expected < 1.25
