"""The named recipes of Atari games (arXiv 2212.14538, tables 1 and 3)."""

from __future__ import annotations

from dataclasses import replace

from torchrl_tit.networks import (
    CatformerConfig,
    CoBERLConfig,
    EnhancedTITConfig,
    NatureCNNConfig,
    ResNetConfig,
    VanillaTITConfig,
)

from ..networks import NetworkConfig
from .recipe import PPO

_GAMES = {
    "breakout": "ALE/Breakout-v5",
    "mspacman": "ALE/MsPacman-v5",
    "pong": "ALE/Pong-v5",
    "spaceinvaders": "ALE/SpaceInvaders-v5",
}
# The paper leaves open which settings of TIT were used where, within two or four blocks, patch 6,
# 12 or 42, width 64 or 128 and two or four heads.
_ENHANCED_TIT = EnhancedTITConfig(
    patch_size=12,
    embed_dim=64,
    num_heads_inner=4,
    num_heads_outer=4,
    attention_dropout_inner=0.1,
    attention_dropout_outer=0.1,
    ffn_dropout_inner=0.1,
    ffn_dropout_outer=0.1,
    features_dim=512,
    activation_head="gelu",
)
_TIT: dict[str, NetworkConfig] = {
    "vanilla-tit": VanillaTITConfig(
        **{name: getattr(_ENHANCED_TIT, name) for name in VanillaTITConfig.__dataclass_fields__}
    ),
    "enhanced-tit": _ENHANCED_TIT,
    "enhanced-tit-wo-dense": replace(_ENHANCED_TIT, dense=False),
    "enhanced-tit-wo-inner": replace(_ENHANCED_TIT, inner=False),
    "enhanced-tit-wo-outer": replace(_ENHANCED_TIT, outer=False),
}
_BASELINES: dict[str, NetworkConfig] = {
    "nature-cnn": NatureCNNConfig(),
    "resnet": ResNetConfig(),
    "catformer": CatformerConfig(),
    "coberl": CoBERLConfig(),
}


def _named(game: str) -> list[PPO]:
    """All recipes of a game: the settings are those of rl-baselines3-zoo."""
    base = PPO(
        env=_GAMES[game],
        history=4,
        padding="constant",
        backbone=NatureCNNConfig(),
        num_envs=8,
        total_steps=10_000_000,
        steps_per_batch=8 * 128,
        minibatch_size=256,
        epochs=4,
        learning_rate=2.5e-4,
        decay_learning_rate=True,
        clip_epsilon=0.1,
        decay_clip_epsilon=True,
        entropy_coeff=0.01,
        clip_rewards=True,
        # Games cannot be saved: new ones begin at each checkpoint (docs/environments.md).
        checkpoint_interval=500_000,
    )
    recipes = {name: replace(base, backbone=network) for name, network in _BASELINES.items()}
    # The skills of the baselines' own papers (for CoBERL arXiv 2107.05431); how long the warm-up is
    # and which of their other skills "+tuned" had, arXiv 2212.14538 does not say.
    tuned = replace(base, warmup_steps=200_000, initialization="own")
    recipes |= {
        "catformer-tuned": replace(
            tuned, backbone=CatformerConfig(attention_expansion=2, ffn_expansion=4)
        ),
        "coberl-tuned": replace(tuned, backbone=CoBERLConfig(gate_bias=2.0), contrastive_coeff=1.0),
    }
    tit = replace(base, minibatch_size=64)
    recipes |= {name: replace(tit, backbone=network) for name, network in _TIT.items()}
    return [replace(recipe, name=f"ppo/{game}/{name}") for name, recipe in recipes.items()]


ATARI_RECIPES: dict[str, PPO] = {recipe.name: recipe for game in _GAMES for recipe in _named(game)}
"""The recipes by name."""
