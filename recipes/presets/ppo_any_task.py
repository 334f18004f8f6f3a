"""The named recipes for your own tasks: PPO on any task that ``--env`` names."""

from __future__ import annotations

from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import lstm, mlp

from .ppo_settings import PPO_SETTINGS, reliable_tit
from .preset import PPO, NovelPPO, Preset

# The task determines the patches, and the encoders of several observations.
_NETWORKS: dict[str, Network] = {
    "enhanced-tit": reliable_tit("enhanced-tit", 4),
    "vanilla-tit": reliable_tit("vanilla-tit", 4),
    "mlp": mlp(),
    "lstm": lstm(),
}

ANY_TASK_RECIPES: dict[str, Preset] = {
    f"ppo/{network}{ending}": make(
        name=f"ppo/{network}{ending}", env="CartPole-v1", backbone=backbone, **PPO_SETTINGS
    )
    for ending, make in (("", PPO), ("-noveld", NovelPPO))
    for network, backbone in _NETWORKS.items()
}
"""The recipes by name; without ``--env`` they train on CartPole. Those whose names end in "-noveld"
have a bonus for what is new, for tasks that give a reward seldom."""
