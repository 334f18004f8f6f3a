"""The environments of a run, shared among several collectors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torchrl.envs import EnvBase

from .recipe import Recipe


def make_share(
    make_envs: Callable[[int, int], EnvBase],
    recipe: Recipe,
    num_envs: int,
    step: int,
    index: int,
) -> EnvBase:
    """Builds the environments of one collector; called in that collector's process.

    Random numbers depend on the run's seed and on the step at which the process starts.

    Args:
        make_envs: builds environments, given their number and the seed of the first one.
        recipe: the settings.
        num_envs: number of environments that each collector has.
        step: number of steps that the run has done.
        index: number of the collector.
    """
    torch.set_num_threads(recipe.threads)
    seeds = np.random.SeedSequence([recipe.seed, index, step])
    torch.manual_seed(seeds.generate_state(1).item())
    # At the start, the environments have the same seeds as in one process.
    seed = recipe.seed + index * num_envs if step == 0 else seeds.generate_state(2)[1].item() >> 1
    return make_envs(num_envs, seed)
