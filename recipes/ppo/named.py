"""The named recipes of classic control and MuJoCo (arXiv 2212.14538, table 2)."""

from __future__ import annotations

from dataclasses import replace

from torchrl_tit.networks import (
    D2RLConfig,
    EnhancedTITConfig,
    MLPConfig,
    OFENetConfig,
    VanillaTITConfig,
)

from ..networks import NetworkConfig
from .recipe import PPO
from .tuned import TUNED_TIT

# Task name: environment and steps (arXiv 2212.14538, appendix). The paper ran MuJoCo's v3.
_TASKS = {
    "acrobot": ("Acrobot-v1", 100_000),
    "cartpole": ("CartPole-v1", 100_000),
    "mountaincar": ("MountainCar-v0", 100_000),
    "ant": ("Ant-v5", 1_000_000),
    "halfcheetah": ("HalfCheetah-v5", 1_000_000),
    "hopper": ("Hopper-v5", 1_000_000),
    "walker2d": ("Walker2d-v5", 1_000_000),
}
# The paper leaves open which settings of TIT were used where, within patch 1, width 32 or 64, two
# blocks; these are the networks' defaults.
_ARRAY_NETWORKS: dict[str, NetworkConfig] = {
    "mlp": MLPConfig(),
    "ofenet": OFENetConfig(),
    "d2rl": D2RLConfig(),
    "vanilla-tit": VanillaTITConfig(),
    "enhanced-tit": EnhancedTITConfig(),
}
# Published by the authors for this task alone.
_MOUNTAINCAR_NETWORKS: dict[str, NetworkConfig] = {
    "vanilla-tit": VanillaTITConfig(
        embed_dim=32, num_heads_inner=4, num_heads_outer=8, features_dim=64
    ),
    "enhanced-tit": EnhancedTITConfig(
        embed_dim=16, num_heads_inner=4, num_heads_outer=8, features_dim=128
    ),
}


def _named() -> dict[str, PPO]:
    recipes: dict[str, PPO] = {}
    for task, (env, total_steps) in _TASKS.items():
        networks = _ARRAY_NETWORKS | (_MOUNTAINCAR_NETWORKS if task == "mountaincar" else {})
        for network, backbone in networks.items():
            name = f"ppo/{task}/{network}"
            recipe = PPO(name=name, env=env, total_steps=total_steps, backbone=backbone)
            recipes[name] = recipe
            if isinstance(backbone, EnhancedTITConfig | VanillaTITConfig):
                name += "-tuned"
                tuned = dict(TUNED_TIT[task])
                other = replace(backbone, **tuned.pop("backbone", {}))
                recipes[name] = replace(recipe, name=name, backbone=other, **tuned)
    return recipes


ARRAY_RECIPES: dict[str, PPO] = _named()
"""The recipes by name."""
