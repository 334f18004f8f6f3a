"""The named recipes of MinAtar's games (Young and Tian, arXiv 1903.03176)."""

from __future__ import annotations

from dataclasses import replace

from torchrl_tit.settings import Network, StackedCNN
from torchrl_tit.settings.networks import nature_cnn

from .ppo_settings import PICTURE_SETTINGS, enhanced_tit_of_pictures
from .preset import PPO, Preset

_GAMES = ("Asterix", "Breakout", "Freeway", "Seaquest", "SpaceInvaders")
_NETWORKS: dict[str, Network] = {
    # MinAtar's own baseline, which reads one frame: the games' channels show where things move.
    "minatar-cnn": replace(nature_cnn(features_dim=128), history=StackedCNN(torso="minatar-cnn")),
    **enhanced_tit_of_pictures(4, patch_size=2),
}

MINATAR_RECIPES: dict[str, Preset] = {
    name: PPO(
        name=name,
        env=f"MinAtar/{game}-v1",
        image_layout="HWC",  # up to ten channels
        total_steps=1_000_000,
        backbone=backbone,
        **PICTURE_SETTINGS,
    )
    for game in _GAMES
    for network, backbone in _NETWORKS.items()
    if "-wo-" not in network or game in ("Asterix", "Breakout")
    for name in [f"ppo/minatar-{game.lower()}/{network}"]
}
"""The recipes by name; the ablations of Enhanced_TIT on two games."""
