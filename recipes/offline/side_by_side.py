"""Runs of several seeds that are trained in one process, all at the same step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torchrl_tit.checkpoint import checkpoint_steps

from ..recipe import Recipe
from ..run import Run


def check_side_by_side(recipes: Sequence[Recipe]) -> None:
    """Checks that recipes can be trained in one process.

    Raises:
        ValueError: if they are of an algorithm that trains one seed at a time, a seed is there
            twice, or they differ in more than the seed.

    Example:
        >>> from recipes.registry import get_recipe
        >>> recipe = get_recipe("cql/hopper-medium-v0/mlp")
        >>> check_side_by_side([recipe, recipe])
        Traceback (most recent call last):
            ...
        ValueError: seed 0 is there twice: every run side by side needs a seed of its own
    """
    first, *others = recipes
    if others and not first.trains_side_by_side:
        raise ValueError(
            f"{first.algorithm} recipes train one seed at a time: train them with sweep, each in a "
            "process of its own"
        )
    seeds = [recipe.seed for recipe in recipes]
    for seed in seeds:
        if seeds.count(seed) > 1:
            raise ValueError(
                f"seed {seed} is there twice: every run side by side needs a seed of its own"
            )
    for other in others:
        if replace(other, seed=first.seed) != first:
            raise ValueError(
                f"the runs of seeds {first.seed} and {other.seed} differ in more than the seed: "
                "resume each alone"
            )


def common_step(runs: Sequence[Run]) -> int:
    """Finds the newest step that all runs have a checkpoint of; 0 where there is none yet.

    Raises:
        ValueError: if some run is further ahead than a kill can leave it.
    """
    # A kill while the runs are saved leaves some one checkpoint ahead, and another beside that.
    newest = [[0, *checkpoint_steps(run.checkpoints)][-3:] for run in runs]
    common = set(newest[0]).intersection(*newest[1:])
    if not common:
        at = ", ".join(f"{run.folder} {steps[-1]}" for run, steps in zip(runs, newest, strict=True))
        raise ValueError(f"the runs are at different steps, so they cannot go on together: {at}")
    return max(common)
