"""The named recipes of tasks without their velocities: what a history is for.

The paper's runs on arrays see one observation (K = 1), which does not test the outer transformer.
All networks train with the same settings. ``-tuned`` takes the whole observation for one patch and
tells time steps apart, which docs/results/cartpole_no_velocity.md found to matter.
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
# Entries of an observation without velocities.
_VISIBLE = {"cartpole": 2, "acrobot": 4, "hopper": 5}


def _networks(task: str) -> dict[str, tuple[int, NetworkConfig]]:
    """The networks, each with the history K that it reads."""
    tit = EnhancedTITConfig(**TUNED_TIT[task].get("backbone", {}))
    tit = replace(tit, patch_size=min(tit.patch_size, _VISIBLE[task]))
    positions = replace(tit, temporal_position_encoding=True)
    return {
        "mlp": (1, MLPConfig()),
        "mlp-stack-8": (8, MLPConfig()),
        "lstm": (1, LSTMConfig()),
        "enhanced-tit-k1": (1, tit),
        "enhanced-tit-k8": (8, tit),
        "enhanced-tit-k8-positions": (8, positions),
        "enhanced-tit-k8-tuned": (8, replace(positions, patch_size=_VISIBLE[task])),
        "enhanced-tit-wo-outer-k8": (8, replace(tit, outer=False)),
    }


def _named(task: str) -> list[PPO]:
    """All recipes of a task."""
    tuned = {field: value for field, value in TUNED_TIT[task].items() if field != "backbone"}
    return [
        PPO(
            name=f"ppo/{task}-no-velocity/{network}",
            hide_velocities=True,
            history=history,
            backbone=backbone,
            **_SETTINGS[task],
            **tuned,
        )
        for network, (history, backbone) in _networks(task).items()
    ]


NO_VELOCITY_RECIPES: dict[str, PPO] = {
    recipe.name: recipe for task in _SETTINGS for recipe in _named(task)
}
"""The recipes by name."""
