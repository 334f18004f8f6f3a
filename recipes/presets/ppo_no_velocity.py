"""The named recipes of tasks without velocities, which need a history.

The paper's runs on arrays see one observation (K = 1), which does not test the outer transformer.
All networks train with the same settings. ``-tuned`` takes the whole observation as one patch and
tells time steps apart, which docs/results/cartpole_no_velocity.md found to matter.
"""

from __future__ import annotations

from typing import Any

from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import enhanced_tit, lstm, mlp

from ..ppo import PPO
from .ppo_tuned import TUNED_TIT

# What TIT needs in addition to the protocol's settings, for all networks alike.
_SETTINGS: dict[str, dict[str, Any]] = {
    "cartpole": {"env": "CartPole-v1", "total_steps": 100_000},
    "acrobot": {"env": "Acrobot-v1", "total_steps": 100_000},
    "hopper": {"env": "Hopper-v5", "total_steps": 1_000_000},
}
# Entries of an observation without velocities.
_VISIBLE = {"cartpole": 2, "acrobot": 4, "hopper": 5}


def _networks(task: str) -> dict[str, Network]:
    visible, tuned = _VISIBLE[task], TUNED_TIT[task]
    patch_size = min(tuned.patch_size or visible, visible)
    tit: dict[str, Any] = {"patch_size": patch_size, "activation_head": tuned.activation_head}
    positions = {**tit, "temporal_positions": "learned"}
    return {
        "mlp": mlp(),
        "mlp-stack-8": mlp(8),
        "lstm": lstm(),
        "enhanced-tit-k1": enhanced_tit(1, **tit),
        "enhanced-tit-k8": enhanced_tit(8, **tit),
        "enhanced-tit-k8-positions": enhanced_tit(8, **positions),
        "enhanced-tit-k8-tuned": enhanced_tit(8, **{**positions, "patch_size": visible}),
        "enhanced-tit-wo-outer-k8": enhanced_tit(8, outer=False, **tit),
    }


def _named(task: str) -> list[PPO]:
    """All recipes of a task."""
    return [
        PPO(
            name=f"ppo/{task}-no-velocity/{network}",
            hide_velocities=True,
            backbone=backbone,
            **_SETTINGS[task],
            **TUNED_TIT[task].fields,
        )
        for network, backbone in _networks(task).items()
    ]


NO_VELOCITY_RECIPES: dict[str, PPO] = {
    recipe.name: recipe for task in _SETTINGS for recipe in _named(task)
}
"""The recipes by name."""
