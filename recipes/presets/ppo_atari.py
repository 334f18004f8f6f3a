"""The named recipes of Atari games (arXiv 2212.14538, tables 1, 4 and 11)."""

from __future__ import annotations

from typing import Any

from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import (
    catformer,
    coberl,
    enhanced_tit,
    nature_cnn,
    resnet,
    vanilla_tit,
)

from .preset import PPO, ContrastivePPO, Preset

_GAMES = {
    "breakout": "ALE/Breakout-v5",
    "mspacman": "ALE/MsPacman-v5",
    "pong": "ALE/Pong-v5",
    "spaceinvaders": "ALE/SpaceInvaders-v5",
}
# The paper does not say which settings of TIT were used for which game, within two or four blocks,
# patch 6, 12 or 42, width 64 or 128 and two or four heads.
_HYPERPARAMETERS: dict[str, Any] = {
    "patch_size": 12,
    "embed_dim": 64,
    "num_heads_inner": 4,
    "num_heads_outer": 4,
    "attention_dropout_inner": 0.1,
    "attention_dropout_outer": 0.1,
    "ffn_dropout_inner": 0.1,
    "ffn_dropout_outer": 0.1,
    "features_dim": 512,
    "activation_head": "gelu",
}
_TIT: dict[str, Network] = {
    "vanilla-tit": vanilla_tit(4, **_HYPERPARAMETERS),
    "enhanced-tit": enhanced_tit(4, **_HYPERPARAMETERS),
    "enhanced-tit-wo-dense": enhanced_tit(4, dense=False, **_HYPERPARAMETERS),
    "enhanced-tit-wo-inner": enhanced_tit(4, inner=False, **_HYPERPARAMETERS),
    "enhanced-tit-wo-outer": enhanced_tit(4, outer=False, **_HYPERPARAMETERS),
}
_BASELINES: dict[str, Network] = {
    "nature-cnn": nature_cnn(4),
    "resnet": resnet(4),
    "catformer": catformer(4),
    "coberl": coberl(4),
}


def _named(game: str) -> list[Preset]:
    """All recipes of a game, with the settings of rl-baselines3-zoo."""
    base = PPO(
        env=_GAMES[game],
        padding="constant",
        backbone=nature_cnn(4),
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
    )
    recipes = {name: base.replace(backbone=network) for name, network in _BASELINES.items()}
    # The techniques of the baselines' own papers (for CoBERL arXiv 2107.05431). arXiv 2212.14538
    # does not say how long the warm-up is, or which of their other techniques "+tuned" had.
    tuned = base.replace(warmup_steps=200_000, initialization="own")
    recipes |= {
        "catformer-tuned": tuned.replace(
            backbone=catformer(4, attention_expansion=2, ffn_expansion=4)
        ),
        "coberl-tuned": ContrastivePPO(
            **{**tuned.fields, "backbone": coberl(4, gate_bias=2.0), "contrastive_coeff": 1.0}
        ),
    }
    tit = base.replace(minibatch_size=64)  # the authors' code; the paper names no other than 256
    recipes |= {name: tit.replace(backbone=network) for name, network in _TIT.items()}
    return [recipe.replace(name=f"ppo/{game}/{name}") for name, recipe in recipes.items()]


ATARI_RECIPES: dict[str, Preset] = {
    recipe.name: recipe for game in _GAMES for recipe in _named(game)
}
"""The recipes by name."""
