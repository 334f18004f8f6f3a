"""SAC, which the paper does not use: with the MLP of D4RL's agents, and with TIT."""

from __future__ import annotations

from torchrl_tit.settings.networks import enhanced_tit, mlp

from .preset import SAC, Preset, of_networks

# The whole observation is one patch, as docs/results/classic_control.md found for PPO.
_NETWORKS = {
    "mlp": mlp(hidden_dim=256, activation="relu"),
    "enhanced-tit": enhanced_tit(patch_size=None, embed_dim=64),
}

RECIPES: list[Preset] = of_networks(SAC, "sac/hopper", _NETWORKS, env="Hopper-v5")
