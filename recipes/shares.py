"""The environments of a run, shared among several collectors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torchrl.envs import EnvBase

from .recipe import Recipe
from .task import seed_copies


def make_share(
    make_envs: Callable[[int], EnvBase],
    recipe: Recipe,
    num_envs: int,
    step: int,
    index: int,
) -> EnvBase:
    """Builds the environments of one collector; called in that collector's process.

    Random numbers depend on the run's seed and on the step at which the process starts.

    Args:
        make_envs: builds a number of environments.
        recipe: the settings.
        num_envs: number of environments that each collector has.
        step: number of steps that the run has done.
        index: number of the collector.
    """
    torch.set_num_threads(recipe.threads)
    seeds = np.random.SeedSequence([recipe.seed, index, step])
    torch.manual_seed(seeds.generate_state(1).item())
    # The environments have the same seeds as in one process.
    return seed_copies(make_envs(num_envs), recipe.seed, step, first=index * num_envs)
