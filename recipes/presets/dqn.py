"""DQN, which the paper does not use, with TIT and with the usual networks.

The settings are those of CleanRL, except for the number of environments and the MLP's width.
"""

from __future__ import annotations

from torchrl_tit.settings.networks import enhanced_tit, mlp, nature_cnn

from .ppo_atari import TIT_PROTOCOL
from .preset import DQN, Preset, of_networks


def _named() -> list[Preset]:
    cartpole = of_networks(
        DQN,
        "dqn/cartpole",
        {
            "mlp": mlp(hidden_dim=256, activation="relu"),
            "enhanced-tit": enhanced_tit(patch_size=2),
        },
        env="CartPole-v1",
        num_envs=8,
        steps_per_batch=80,
    )
    pong = of_networks(
        DQN,
        "dqn/pong",
        {"nature-cnn": nature_cnn(4), "enhanced-tit": TIT_PROTOCOL["enhanced-tit"]},
        env="ALE/Pong-v5",
        padding="constant",
        num_envs=8,
        total_steps=10_000_000,
        random_steps=80_000,
        buffer_size=1_000_000,
        steps_per_batch=32,
        updates_per_step=0.25,
        batch_size=32,
        learning_rate=1e-4,
        final_epsilon=0.01,
        exploration_fraction=0.1,
        target_interval=250,
        clip_rewards=True,
    )
    return [*cartpole, *pong]


RECIPES: list[Preset] = _named()
"""``dqn/TASK/NETWORK``."""
