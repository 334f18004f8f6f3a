"""The named recipes for your own tasks: PPO on any task that ``--env`` names."""

from __future__ import annotations

from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import lstm, mlp

from .ppo_settings import reliable_tit, settings_of
from .preset import PPO, NovelPPO, Preset, SmoothPPO

# The task determines the patches, and the encoders of several observations.
_NETWORKS: dict[str, Network] = {
    "enhanced-tit": reliable_tit("enhanced-tit", 4),
    "vanilla-tit": reliable_tit("vanilla-tit", 4),
    "mlp": mlp(),
    "lstm": lstm(),
}

# The ending of the name, the algorithm, and the task without --env.
_ALGORITHMS = {
    "": (PPO, "CartPole-v1"),
    "-noveld": (NovelPPO, "CartPole-v1"),  # a bonus for what is new, where rewards are rare
    "-gsde": (SmoothPPO, "Pendulum-v1"),  # smooth noise, for continuous actions
}

RECIPES: list[Preset] = [
    make(name=f"ppo/{network}{ending}", env=env, backbone=backbone, **settings_of(network))
    for ending, (make, env) in _ALGORITHMS.items()
    for network, backbone in _NETWORKS.items()
]
