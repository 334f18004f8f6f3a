"""The paper's runs of Decision Transformer and DT_TIT, as data."""

from __future__ import annotations

from torchrl_tit.networks import DecisionTransformerConfig

from .dt import DT
from .recipe import Recipe

# Task name: environment and target returns (arXiv 2106.01345, appendix). The paper ran the tasks'
# v3, as D4RL's data are; v4 is nearer to that than v5.
_TASKS = {
    "halfcheetah": ("HalfCheetah-v4", (12000.0, 6000.0)),
    "hopper": ("Hopper-v4", (3600.0, 1800.0)),
    "walker2d": ("Walker2d-v4", (5000.0, 2500.0)),
}
_NETWORKS = {
    "dt": DecisionTransformerConfig(),
    "dt-tit": DecisionTransformerConfig(state_encoder="inner_transformer"),
}


def _named() -> dict[str, Recipe]:
    recipes: dict[str, Recipe] = {}
    for task, (env, target_returns) in _TASKS.items():
        for dataset in (f"{task}-medium-v2", f"{task}-medium-replay-v2"):
            for network, config in _NETWORKS.items():
                name = f"dt/{dataset}/{network}"
                recipes[name] = DT(
                    name=name,
                    dataset=dataset,
                    env=env,
                    target_returns=target_returns,
                    backbone=config,
                )
    return recipes


DT_RECIPES = _named()
"""``dt/DATASET/dt`` and ``dt/DATASET/dt-tit`` for D4RL's sets of version 2."""
