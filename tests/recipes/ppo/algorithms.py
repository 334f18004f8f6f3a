"""PPO's algorithm, ready to update, without its environments."""

from pathlib import Path

import torch

from recipes.core.registry import get_recipe
from recipes.ppo import PPO, PPOAlgorithm


def named(name: str) -> PPO:
    """A named recipe of PPO."""
    recipe = get_recipe(name)
    assert isinstance(recipe, PPO)
    return recipe


def prepared(recipe: PPO, folder: Path) -> PPOAlgorithm:
    """Loss and optimizer are built; the collector, which is closed, is not needed."""
    algorithm = recipe.build()
    algorithm.prepare(0, folder)
    algorithm.close()
    return algorithm


def trained(recipe: PPO, folder: Path, batches: int) -> PPOAlgorithm:
    """An algorithm after updates on a number of batches."""
    algorithm = PPOAlgorithm(recipe)
    algorithm.prepare(0, folder)
    step = 0
    for batch, _ in zip(algorithm.batches(), range(batches), strict=False):
        algorithm.update(batch, step)
        step += recipe.steps_per_batch
    algorithm.close()
    return algorithm


def perturb(model):
    """Moves weights to where all actions and values are not alike."""
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))


def note_calls(monkeypatch, method, note):
    """Calls ``note(result, algorithm, *arguments)`` after each call of a method of PPO's."""
    original = getattr(PPOAlgorithm, method)

    def noting(*arguments):
        result = original(*arguments)
        note(result, *arguments)
        return result

    monkeypatch.setattr(PPOAlgorithm, method, noting)
