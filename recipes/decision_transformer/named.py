"""The paper's runs of Decision Transformer and DT_TIT, and Online Decision Transformer, as data."""

from __future__ import annotations

from dataclasses import replace

from torchrl_tit.networks import DecisionTransformerConfig

from ..recipe import Recipe
from .dt import DT
from .odt import NETWORK, ODT

# Task name: environment and target returns (arXiv 2106.01345, appendix). The paper ran the tasks'
# v3, as D4RL's data are; v4 is nearer to that than v5.
_TASKS = {
    "halfcheetah": ("HalfCheetah-v4", (12000.0, 6000.0)),
    "hopper": ("Hopper-v4", (3600.0, 1800.0)),
    "walker2d": ("Walker2d-v4", (5000.0, 2500.0)),
}


def _networks(
    algorithm: str, linear: DecisionTransformerConfig
) -> dict[str, DecisionTransformerConfig]:
    tit = replace(linear, state_encoder="inner_transformer")
    return {algorithm: linear, f"{algorithm}-tit": tit}


def _named() -> dict[str, Recipe]:
    recipes: list[Recipe] = []
    for task, (env, target_returns) in _TASKS.items():
        for dataset in (f"{task}-medium-v2", f"{task}-medium-replay-v2"):
            recipes += [
                DT(
                    name=f"dt/{dataset}/{network}",
                    dataset=dataset,
                    env=env,
                    target_returns=target_returns,
                    backbone=config,
                )
                for network, config in _networks("dt", DecisionTransformerConfig()).items()
            ]
    for dataset in ("hopper-medium-v2", "hopper-medium-replay-v2"):
        for network, config in _networks("odt", NETWORK).items():
            full = ODT(
                name=f"odt/{dataset}/{network}",
                dataset=dataset,
                env="Hopper-v4",
                target_returns=(3600.0,),
                online_return=7200.0,
                backbone=config,
            )
            # What a CPU can do in minutes: a smaller network that learns faster, is asked for
            # returns that are in the data, and sees as much when it acts as in training.
            small = replace(
                full,
                name=f"{full.name}-small",
                backbone=replace(config, embed_dim=64, num_blocks=2, num_heads=2),
                acting_context=None,
                target_returns=(3000.0,),
                online_return=3200.0,
                batch_size=64,
                learning_rate=1e-3,
                warmup_updates=100,
                pretraining_updates=500,
                rounds=60,
                updates_per_round=30,
                evaluation_episodes=20,
                log_interval=30,
            )
            recipes += [full, small]
    return {recipe.name: recipe for recipe in recipes}


DT_RECIPES = _named()
"""``dt/DATASET/dt`` and ``dt/DATASET/dt-tit`` for D4RL's sets of version 2, and ``odt/...``."""
