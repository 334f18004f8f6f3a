"""The named recipes for tasks of one's own: PPO on whatever ``--env`` names."""

from __future__ import annotations

from torchrl_tit.settings import Network
from torchrl_tit.settings.networks import enhanced_tit, lstm, mlp, vanilla_tit

from ..ppo import PPO

# Patches, and the encoders of several observations, follow from the task.
_NETWORKS: dict[str, Network] = {
    "enhanced-tit": enhanced_tit(4, patch_size="auto"),
    "vanilla-tit": vanilla_tit(4, patch_size="auto"),
    "mlp": mlp(),
    "lstm": lstm(),
}

ANY_TASK_RECIPES: dict[str, PPO] = {
    f"ppo/{network}": PPO(name=f"ppo/{network}", env="CartPole-v1", num_envs=8, backbone=backbone)
    for network, backbone in _NETWORKS.items()
}
"""The recipes by name; without ``--env`` they train on CartPole."""
