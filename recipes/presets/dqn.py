"""DQN, which the paper does not use, with TIT and with the usual networks.

The settings are those of CleanRL, except for the number of environments, the MLP's width, and those
of tasks without velocities.
"""

from __future__ import annotations

from typing import Any

from torchrl_tit.settings.networks import lstm, mlp, nature_cnn

from .ppo_atari import TIT_PROTOCOL
from .ppo_settings import reliable_tit
from .preset import DQN, Preset, of_networks

_CARTPOLE: dict[str, Any] = {"env": "CartPole-v1", "num_envs": 8, "steps_per_batch": 80}

_HEAD: dict[str, Any] = {"activation_head": "gelu"}
"""A value is a hundred rewards, which features between -1 and 1 are slow to add up to."""

_SLICES: dict[str, dict[str, Any]] = {
    "lstm": {"slice_length": 16, "burn_in": 8},
    "enhanced-tit-k8": {"slice_length": 4},
}
"""The steps that are drawn together, because they share a state, or frames."""


def _named() -> list[Preset]:
    cartpole = of_networks(
        DQN,
        "dqn/cartpole",
        {
            "mlp": mlp(hidden_dim=256, activation="relu"),
            "enhanced-tit": reliable_tit("enhanced-tit", **_HEAD),
        },
        **_CARTPOLE,
    )
    no_velocity = of_networks(
        DQN,
        "dqn/cartpole-no-velocity",
        {
            "mlp-stack-8": mlp(8, hidden_dim=256, activation="relu"),
            "lstm": lstm(),
            "enhanced-tit-k8": reliable_tit("enhanced-tit", 8, **_HEAD),
        },
        **_CARTPOLE,
        hide_velocities=True,
        total_steps=200_000,
        buffer_size=100_000,
        # A pole tilts by a tenth of a radian, and moves a tenth of that in a step.
        normalize_observations=True,
    )
    no_velocity = [
        recipe.replace(**_SLICES.get(recipe.name.rpartition("/")[2], {})) for recipe in no_velocity
    ]
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
    return [*cartpole, *no_velocity, *pong]


RECIPES: list[Preset] = _named()
"""``dqn/TASK/NETWORK``."""
