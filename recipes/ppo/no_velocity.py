"""The named recipes of tasks without their velocities: what a history is for.

The paper's runs on arrays see one observation (K = 1), which does not test the outer transformer.
All networks train with the same settings.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from torchrl_tit.modules import LSTMConfig
from torchrl_tit.networks import EnhancedTITConfig, MLPConfig

from ..networks import NetworkConfig
from .recipe import PPO
from .tuned import TUNED_TIT

# Beyond the protocol's settings those that TIT needs, for all networks alike.
_SETTINGS: dict[str, dict[str, Any]] = {
    "cartpole": {"env": "CartPole-v1", "total_steps": 100_000},
    "acrobot": {"env": "Acrobot-v1", "total_steps": 100_000},
    "hopper": {"env": "Hopper-v5", "total_steps": 1_000_000},
}
_NETWORKS: dict[str, tuple[int, NetworkConfig]] = {  # with the history K
    "mlp": (1, MLPConfig()),
    "mlp-stack-8": (8, MLPConfig()),
    "lstm": (1, LSTMConfig()),
    "enhanced-tit-k1": (1, EnhancedTITConfig()),
    "enhanced-tit-k8": (8, EnhancedTITConfig()),
    "enhanced-tit-k8-positions": (8, EnhancedTITConfig(temporal_position_encoding=True)),
    "enhanced-tit-wo-outer-k8": (8, EnhancedTITConfig(outer=False)),
}


def _named(task: str, network: str) -> PPO:
    history, backbone = _NETWORKS[network]
    tuned = dict(TUNED_TIT[task])
    for_tit = tuned.pop("backbone", {})
    if isinstance(backbone, EnhancedTITConfig):
        backbone = replace(backbone, **for_tit)
    return PPO(
        name=f"ppo/{task}-no-velocity/{network}",
        hide_velocities=True,
        history=history,
        backbone=backbone,
        **_SETTINGS[task],
        **tuned,
    )


NO_VELOCITY_RECIPES: dict[str, PPO] = {
    recipe.name: recipe for recipe in (_named(task, net) for task in _SETTINGS for net in _NETWORKS)
}
"""The recipes by name."""
