"""SAC, which the paper does not use: with the MLP of D4RL's agents, and with TIT."""

from __future__ import annotations

from torchrl_tit.settings.networks import enhanced_tit, mlp

from .preset import SAC, Preset

# The whole observation is one patch, as docs/results/classic_control.md found for PPO.
SAC_RECIPES: dict[str, Preset] = {
    recipe.name: recipe
    for recipe in (
        SAC(
            name="sac/hopper/mlp",
            env="Hopper-v5",
            backbone=mlp(hidden_dim=256, activation="relu"),
        ),
        SAC(
            name="sac/hopper/enhanced-tit",
            env="Hopper-v5",
            backbone=enhanced_tit(patch_size=None, embed_dim=64),
        ),
    )
}
"""The recipes by name."""
