"""Runs without training, for what is done with a run."""

from __future__ import annotations

from pathlib import Path

from recipes.core.algorithm import make_algorithm
from recipes.core.recipe import Recipe
from recipes.core.run import Run


def untrained(folder: Path, recipe: Recipe) -> Run:
    """Makes a run whose checkpoint has the weights that training would start from."""
    run = Run.create(folder, recipe)
    run.save(0, {"networks": make_algorithm(recipe).model.state_dict()})
    return run
