"""Recipes of tasks that only memory solves: they differ in the memory alone."""

from dataclasses import replace

import pytest

pytest.importorskip("minigrid")
pytest.importorskip("popgym")

from recipes.core.algorithm import make_algorithm
from recipes.presets import ppo_memory
from tests.recipes.ppo.algorithms import named
from torchrl_tit.settings import Inner

MEMORY_RECIPES = {name: named(name) for name in ppo_memory.MEMORY_RECIPES}
TASKS = sorted({name.rpartition("/")[0] for name in MEMORY_RECIPES})
SHAPES = {"tmaze": (2,), "repeat": (1,), "memory-s": (3, 24, 24)}
T_MAZES = [task for task in TASKS if "tmaze" in task]


@pytest.mark.parametrize("task", TASKS)
def test_only_the_memory_differs(task):
    recipes = {
        name: recipe for name, recipe in MEMORY_RECIPES.items() if name.startswith(f"{task}/")
    }
    frames = set()
    for recipe in recipes.values():
        assert isinstance(recipe.backbone.frame, Inner)
        frames.add(replace(recipe.backbone.frame, every_block=False))
    assert len(frames) == 1, "one frame encoder"
    tit = recipes[f"{task}/enhanced-tit"]
    for recipe in recipes.values():
        assert replace(recipe, name=tit.name, backbone=tit.backbone) == tit
    sizes = []
    for recipe in recipes.values():
        algorithm = make_algorithm(recipe)
        algorithm.check()
        history = algorithm.make_env(1, seed=0).reset()["history"]
        [shape] = [shape for word, shape in SHAPES.items() if word in task]
        assert history.shape == (1, recipe.backbone.num_frames, *shape)
        sizes.append(sum(weights.numel() for weights in algorithm.policy.parameters()))
    assert max(sizes) < 1.1 * min(sizes), "about the same number of weights"


@pytest.mark.parametrize("task", T_MAZES)
def test_the_cue_is_within_reach_of_those_that_should_solve_it(task):
    length = int(task.rpartition("-")[2])
    for name, recipe in MEMORY_RECIPES.items():
        if name.startswith(f"{task}/"):
            reaches = recipe.backbone.num_frames > length or recipe.backbone.carries_state
            assert reaches == ("frames" not in name)
            # So does an LSTM's gradient.
            assert recipe.steps_per_sequence > length


@pytest.mark.parametrize("name", [name for name in MEMORY_RECIPES if "memory-s" in name])
def test_a_patch_of_minigrid_is_a_tile(name):
    (frames,) = make_algorithm(MEMORY_RECIPES[name]).policy[0].module.frames
    assert frames.encoder.patch_embedding.num_patches == 3 * 3
