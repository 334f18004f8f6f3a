"""The named recipes: the paper's experiments as data."""

from __future__ import annotations

from torchrl_tit.networks import (
    D2RLConfig,
    EnhancedTITConfig,
    MLPConfig,
    OFENetConfig,
    VanillaTITConfig,
)

from .networks import NetworkConfig
from .ppo import PPO
from .recipe import Recipe, nearest

# Task name: environment. 100k steps each (arXiv 2212.14538, appendix).
_CLASSIC_CONTROL = {
    "acrobot": "Acrobot-v1",
    "cartpole": "CartPole-v1",
    "mountaincar": "MountainCar-v0",
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


def _named() -> dict[str, Recipe]:
    recipes: dict[str, Recipe] = {}
    for task, env in _CLASSIC_CONTROL.items():
        networks = _ARRAY_NETWORKS | (_MOUNTAINCAR_NETWORKS if task == "mountaincar" else {})
        for network, backbone in networks.items():
            name = f"ppo/{task}/{network}"
            recipes[name] = PPO(name=name, env=env, backbone=backbone)
            if network in ("vanilla-tit", "enhanced-tit"):
                # Policy and value share TIT's backbone: at 0.5 the value's gradient drowns the
                # policy's (docs/results/cartpole.md). And environments side by side, for speed.
                name += "-tuned"
                recipes[name] = PPO(
                    name=name, env=env, backbone=backbone, critic_coeff=0.02, num_envs=8
                )
    return recipes


RECIPES: dict[str, Recipe] = _named()
"""Every named recipe."""


def get_recipe(name: str) -> Recipe:
    """Looks a recipe up.

    Raises:
        ValueError: if there is none of that name; the message names the nearest ones.

    Example:
        >>> get_recipe("ppo/cartpole/enhanced-tit").env
        'CartPole-v1'
    """
    if name not in RECIPES:
        raise ValueError(f"unknown recipe {name!r}: {nearest(name, RECIPES)}")
    return RECIPES[name]
