"""The named recipes of classic control and MuJoCo (arXiv 2212.14538, table 2)."""

from __future__ import annotations

from dataclasses import replace

from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import d2rl, enhanced_tit, mlp, ofenet, vanilla_tit

from ..ppo import PPO
from .ppo_tuned import TUNED_TIT

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
_ARRAY_NETWORKS: dict[str, Network] = {
    "mlp": mlp(),
    "ofenet": ofenet(),
    "d2rl": d2rl(),
    "vanilla-tit": vanilla_tit(),
    "enhanced-tit": enhanced_tit(),
}
# Published by the authors for this task alone.
_MOUNTAINCAR_NETWORKS: dict[str, Network] = {
    "vanilla-tit": vanilla_tit(embed_dim=32, num_heads_inner=4, num_heads_outer=8, features_dim=64),
    "enhanced-tit": enhanced_tit(
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
            if network.endswith("tit"):
                name += "-tuned"
                tuned = TUNED_TIT[task]
                recipes[name] = replace(
                    recipe, name=name, backbone=tuned.adapt(backbone), **tuned.fields
                )
    return recipes


ARRAY_RECIPES: dict[str, PPO] = _named()
"""The recipes by name."""
