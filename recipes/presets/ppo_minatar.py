"""The named recipes of MinAtar's games (Young and Tian, arXiv 1903.03176)."""

from __future__ import annotations

from dataclasses import replace

from torchrl_tit.settings import Network, StackedCNN
from torchrl_tit.settings.networks import nature_cnn

from .ppo_settings import PICTURE_SETTINGS, enhanced_tit_of_pictures
from .preset import PPO, Preset, of_networks

_GAMES = ("Asterix", "Breakout", "Freeway", "Seaquest", "SpaceInvaders")
# MinAtar's own baseline, which reads one frame: the games' channels show where things move.
_CNN: dict[str, Network] = {
    "minatar-cnn": replace(nature_cnn(features_dim=128), history=StackedCNN(torso="minatar-cnn")),
}
_TIT = enhanced_tit_of_pictures(4, patch_size=5)
# Pixels are 0 or 1. Normalized ones have scales of their own, but patches share their weights.
_NETWORKS = ((_CNN, PICTURE_SETTINGS), (_TIT, PICTURE_SETTINGS | {"normalize_observations": False}))

RECIPES: list[Preset] = [
    # Images have up to ten channels.
    recipe.replace(env=f"MinAtar/{game}-v1", image_layout="HWC", total_steps=1_000_000)
    for game in _GAMES
    for networks, settings in _NETWORKS
    for recipe in of_networks(PPO, f"ppo/minatar-{game.lower()}", networks, **settings)
    if "-wo-" not in recipe.name or game in ("Asterix", "Breakout")
]
"""The ablations of Enhanced_TIT are on two games."""
