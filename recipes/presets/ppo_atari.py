"""The named recipes of Atari games (arXiv 2212.14538, tables 1, 4 and 11).

All networks train with one set of settings. Recipes whose names end in "-protocol" or "-tuned" use
those of the paper and its release instead.
"""

from __future__ import annotations

from typing import Any

from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import (
    catformer,
    coberl,
    nature_cnn,
    resnet,
    vanilla_tit,
)

from .ppo_settings import PICTURE_SETTINGS, PICTURE_TIT, enhanced_tit_of_pictures
from .preset import PPO, ContrastivePPO, Preset, of_networks

# Game: environment and steps. The paper ran each for 10,000,000 steps.
_GAMES = {
    "breakout": ("ALE/Breakout-v5", 2_500_000),
    "mspacman": ("ALE/MsPacman-v5", 1_500_000),
    "pong": ("ALE/Pong-v5", 2_500_000),
    "spaceinvaders": ("ALE/SpaceInvaders-v5", 2_500_000),
}
_BASELINES: dict[str, Network] = {
    "nature-cnn": nature_cnn(4),
    "resnet": resnet(4),
    "catformer": catformer(4),
    "coberl": coberl(4),
}
# The paper does not say which settings of TIT were used for which game, within two or four blocks,
# patch 6, 12 or 42, width 64 or 128 and two or four heads.
_PATCHES: dict[str, Any] = {"patch_size": 12}
_TIT: dict[str, Network] = {
    "vanilla-tit": vanilla_tit(4, temporal_positions="learned", **PICTURE_TIT, **_PATCHES),
    **enhanced_tit_of_pictures(4, **_PATCHES),
}
_PROTOCOL: dict[str, Any] = {
    **_PATCHES,
    "attention_dropout_inner": 0.1,
    "attention_dropout_outer": 0.1,
    "ffn_dropout_inner": 0.1,
    "ffn_dropout_outer": 0.1,
}
TIT_PROTOCOL: dict[str, Network] = {
    "vanilla-tit": vanilla_tit(4, **PICTURE_TIT, **_PROTOCOL),
    **enhanced_tit_of_pictures(4, "none", **_PROTOCOL),
}
"""TIT as in the paper, by name."""


def _named(game: str) -> list[Preset]:
    """All recipes of a game."""
    env, total_steps = _GAMES[game]
    base = PPO(env=env, total_steps=total_steps, **PICTURE_SETTINGS)
    networks = _BASELINES | _TIT
    recipes = {name: base.replace(backbone=network) for name, network in networks.items()}
    # The paper's settings are those of rl-baselines3-zoo.
    protocol = base.replace(
        total_steps=10_000_000,
        epochs=4,
        sequence_length=None,
        normalize_observations=False,
        padding="constant",
        decay_learning_rate=True,
        decay_clip_epsilon=True,
    )
    recipes |= {
        f"{name}-protocol": protocol.replace(backbone=network)
        for name, network in _BASELINES.items()
    }
    # The techniques of the baselines' own papers (for CoBERL arXiv 2107.05431). arXiv 2212.14538
    # does not say how long the warm-up is, or which of their other techniques "+tuned" had.
    tuned = protocol.replace(warmup_steps=200_000, initialization="own")
    recipes |= {
        "catformer-tuned": tuned.replace(
            backbone=catformer(4, attention_expansion=2, ffn_expansion=4)
        ),
        "coberl-tuned": ContrastivePPO(
            **{**tuned.fields, "backbone": coberl(4, gate_bias=2.0), "contrastive_coeff": 1.0}
        ),
    }
    tit = protocol.replace(minibatch_size=64)  # the authors' code; the paper names only 256
    recipes |= {
        f"{name}-protocol": tit.replace(backbone=network) for name, network in TIT_PROTOCOL.items()
    }
    return [recipe.replace(name=f"ppo/{game}/{name}") for name, recipe in recipes.items()]


# An agent that remembers where the ball was knows where it is (arXiv 1507.06527, section 5).
_FLICKERING = of_networks(
    PPO,
    "ppo/pong-flickering",
    {
        "nature-cnn": nature_cnn(4),
        "enhanced-tit-k16": enhanced_tit_of_pictures(16, **_PATCHES)["enhanced-tit"],
    },
    env="ALE/Pong-v5",
    env_settings=("blank_probability=0.5",),
    total_steps=2_000_000,
    **PICTURE_SETTINGS,
)

RECIPES: list[Preset] = [*(x for game in _GAMES for x in _named(game)), *_FLICKERING]
