"""The named recipes of tasks without their velocities: what a history is for.

The paper's runs on arrays see one observation (K = 1), which does not test the outer transformer.
All networks train with the same settings.
"""

from __future__ import annotations

from torchrl_tit.modules import LSTMConfig
from torchrl_tit.networks import EnhancedTITConfig, MLPConfig

from .networks import NetworkConfig
from .ppo import PPO

_TASKS = {
    "cartpole": ("CartPole-v1", 100_000),
    "acrobot": ("Acrobot-v1", 100_000),
    "hopper": ("Hopper-v5", 1_000_000),
}
_NETWORKS: dict[str, tuple[int, NetworkConfig]] = {  # with the history K
    "mlp": (1, MLPConfig()),
    "mlp-stack-8": (8, MLPConfig()),
    "lstm": (1, LSTMConfig()),
    "enhanced-tit-k1": (1, EnhancedTITConfig()),
    "enhanced-tit-k8": (8, EnhancedTITConfig()),
    "enhanced-tit-k8-positions": (8, EnhancedTITConfig(temporal_position_encoding=True)),
    "enhanced-tit-wo-outer-k8": (8, EnhancedTITConfig(outer=False)),
}


def _named(task: str, network: str) -> PPO:
    env, total_steps = _TASKS[task]
    history, backbone = _NETWORKS[network]
    return PPO(
        name=f"ppo/{task}-no-velocity/{network}",
        env=env,
        hide_velocities=True,
        history=history,
        backbone=backbone,
        total_steps=total_steps,
        num_envs=8,
        critic_coeff=0.02,  # as in the tuned recipes: see docs/results/cartpole.md
    )


NO_VELOCITY_RECIPES: dict[str, PPO] = {
    recipe.name: recipe for recipe in (_named(task, net) for task in _TASKS for net in _NETWORKS)
}
"""The recipes by name."""
