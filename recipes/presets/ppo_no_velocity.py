"""The named recipes of tasks without velocities, which need a history.

The paper's runs on arrays see one observation (K = 1), which does not test the outer transformer.
"""

from __future__ import annotations

from dataclasses import replace

from torchrl_tit.settings import GTrXL, Inner, Network
from torchrl_tit.settings.networks import enhanced_tit, lstm, mlp

from .ppo_settings import STEADY_PPO_SETTINGS, reliable_tit
from .preset import PPO, Preset, of_networks

_TASKS = {
    "cartpole": ("CartPole-v1", 100_000),
    "acrobot": ("Acrobot-v1", 100_000),
    "hopper": ("Hopper-v5", 1_000_000),
}
_TIT = reliable_tit("enhanced-tit", 8)
_NETWORKS: dict[str, Network] = {
    "mlp": mlp(),
    "mlp-stack-8": mlp(8),
    "lstm": lstm(),
    "gtrxl-k8": replace(
        _TIT,
        frame=Inner(patch_size="auto", patch_weights="own", every_block=False),
        history=GTrXL(num_blocks=1, num_heads=1),
    ),
    "enhanced-tit-k1": reliable_tit("enhanced-tit"),
    "enhanced-tit-k8": _TIT,
    "enhanced-tit-k8-no-positions": reliable_tit("enhanced-tit", 8, temporal_positions="none"),
    "enhanced-tit-wo-outer-k8": enhanced_tit(8, outer=False, patch_size=None),
}

RECIPES: list[Preset] = [
    recipe.replace(env=env, total_steps=total_steps, hide_velocities=True)
    for task, (env, total_steps) in _TASKS.items()
    for recipe in of_networks(PPO, f"ppo/{task}-no-velocity", _NETWORKS, **STEADY_PPO_SETTINGS)
]
