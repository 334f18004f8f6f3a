"""DQN, which the paper does not use, with TIT and with the usual networks.

CartPole has the settings of rl-baselines3-zoo and Pong those of CleanRL, except for the number of
environments and TIT's learning rate on CartPole.
"""

from __future__ import annotations

from torchrl_tit.settings.networks import enhanced_tit, mlp, nature_cnn

from .ppo_atari import ATARI_RECIPES
from .preset import DQN, Preset


def _named() -> list[Preset]:
    cartpole = DQN(
        name="dqn/cartpole/mlp",
        env="CartPole-v1",
        backbone=mlp(hidden_dim=256, activation="relu"),
        num_envs=8,
        total_steps=50_000,
        random_steps=1024,
        steps_per_batch=256,
        updates_per_step=0.5,
        buffer_size=100_000,
        batch_size=64,
        learning_rate=2.3e-3,
        loss_function="smooth_l1",
        final_epsilon=0.04,
        exploration_fraction=0.16,
        target_interval=128,
    )
    pong = DQN(
        name="dqn/pong/nature-cnn",
        env="ALE/Pong-v5",
        padding="constant",
        backbone=nature_cnn(4),
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
    return [
        cartpole,
        cartpole.replace(
            name="dqn/cartpole/enhanced-tit",
            backbone=enhanced_tit(patch_size=2),
            learning_rate=5e-4,
        ),
        pong,
        pong.replace(
            name="dqn/pong/enhanced-tit",
            backbone=ATARI_RECIPES["ppo/pong/enhanced-tit-protocol"].fields["backbone"],
        ),
    ]


DQN_RECIPES: dict[str, Preset] = {recipe.name: recipe for recipe in _named()}
"""``dqn/TASK/NETWORK``."""
