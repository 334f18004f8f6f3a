"""Collectors of PPO runs: one in this process, or several in processes of their own."""

from __future__ import annotations

import signal
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torchrl.collectors import BaseCollector, Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import EnvBase

from torchrl_tit.modules import acting

from .agent import Agent

if TYPE_CHECKING:
    from .recipe import PPO


def make_collector(
    recipe: PPO, env: EnvBase, agent: Agent, step: int, options: Mapping[str, Any] | None
) -> BaseCollector:
    """Builds what collects a run's batches.

    Several collectors share the environments, each in a process of its own with a copy of the
    policy. Their random numbers follow from the run's seed and the step at which they start.

    Args:
        recipe: the settings.
        env: the environment of a collector in this process; several make their own.
        agent: the networks.
        step: environment steps that the run has done.
        options: of ``torch.compile``, for acting in this process; without any it is not compiled.

    Returns:
        A collector of batches [num_envs, time]; if it is asynchronous, of those of one process.
    """
    settings: dict[str, Any] = {
        "frames_per_batch": recipe.steps_per_batch,
        "device": recipe.torch_device(),
        "trust_policy": True,  # ours is on the right device already
        "auto_register_policy_transforms": False,
    }
    if recipe.collectors == 1:
        # What is kept of the frames just seen is decided between two pieces, compiled apart.
        return Collector(
            env,
            agent.policy,
            total_frames=recipe.final_step,
            compile_policy=None if agent.backbone.keeps_frames else options,
            track_traj_ids=False,
            **settings,
        )
    kind = MultiAsyncCollector if recipe.async_collection else MultiSyncCollector
    together = {} if recipe.async_collection else {"cat_results": 0}
    with acting(agent.policy):  # their copies of the policy act for good
        return kind(
            [partial(_make_share, recipe, index, step) for index in range(recipe.collectors)],
            agent.policy,
            total_frames=recipe.final_step - step,
            **together,
            **settings,
        )


def _make_share(recipe: PPO, index: int, step: int) -> EnvBase:
    """Builds the environments of one process, in it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the training process
    torch.set_num_threads(recipe.threads)
    share = recipe.num_envs // recipe.collectors
    seeds = np.random.SeedSequence([recipe.seed, index, step])
    torch.manual_seed(seeds.generate_state(1).item())
    # From the start the environments have the seeds that they have in one process.
    seed = recipe.seed + index * share if step == 0 else seeds.generate_state(2)[1].item() >> 1
    return recipe.make_env(share, seed, vectorization_mode=recipe.vectorization_mode)
