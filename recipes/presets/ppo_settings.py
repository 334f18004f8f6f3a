"""The sets of PPO settings with which transformers, and all other networks here, learn.

docs/results/ppo_settings.md describes how that of arrays was found, what each setting does, and the
results.
"""

from __future__ import annotations

from typing import Any

from torchrl_tit.settings import Network, TemporalPositions
from torchrl_tit.settings.networks import enhanced_tit, vanilla_tit

PPO_SETTINGS: dict[str, Any] = {
    "num_envs": 8,
    "steps_per_batch": 1024,
    "decay_learning_rate": True,
    # Observations and rewards, and therefore values, are of scale 1 in every task.
    "normalize_observations": True,
    "normalize_rewards": True,
    # Once a task is solved, advantages are mostly noise, which must not count as much as a signal.
    "running_advantage_floor": 0.5,
    # A larger deviation of continuous actions does not fall far enough in 100,000 steps.
    "initial_std": 0.5,
    # An update ends once it has moved the policy this far; small minibatches often get there.
    "target_kl": 0.05,
}
"""Fields of the recipe; the others have their defaults, which are Stable-Baselines3's."""


def settings_of(network: str) -> dict[str, Any]:
    """Returns :data:`PPO_SETTINGS` with the learning rate that suits a network.

    An MLP's updates are a fraction of the others' at their rate: docs/results/update_size.md.

    Args:
        network: its name, such as mlp.
    """
    return PPO_SETTINGS | {"learning_rate": 1e-3 if network == "mlp" else 3e-4}


STEADY_PPO_SETTINGS: dict[str, Any] = PPO_SETTINGS | {"minibatch_size": 256, "target_kl": 0.02}
"""The same with smaller and less noisy updates, for tasks that only a history solves."""

PICTURE_SETTINGS: dict[str, Any] = {
    "num_envs": 8,
    "steps_per_batch": 8 * 128,
    "minibatch_size": 256,
    "epochs": 3,
    # Each frame is encoded once for the K steps of a sequence that read it, so all that an
    # environment did in a batch is one sequence.
    "sequence_length": 128,
    # Nothing decays, so a short run is the beginning of a long one.
    "learning_rate": 2.5e-4,
    "clip_epsilon": 0.1,
    "entropy_coeff": 0.01,
    "clip_rewards": True,
    # Otherwise the features of all images are nearly the same: on Pong, for 900,000 steps.
    "normalize_observations": True,
}
"""Fields of the recipes on pictures: those of rl-baselines3-zoo on Atari games, with longer
sequences, one epoch less, and a learning rate and a clipping range that stay as they are."""

PICTURE_TIT: dict[str, Any] = {
    "embed_dim": 64,
    "num_heads_inner": 4,
    "num_heads_outer": 4,
    "features_dim": 512,
    "activation_head": "gelu",
}
"""The sizes of TIT on pictures. It has no dropout, with which the old and the new probability of an
action would differ by chance."""


def enhanced_tit_of_pictures(
    num_frames: int, temporal_positions: TemporalPositions = "learned", **settings: Any
) -> dict[str, Network]:
    """Returns Enhanced_TIT and its ablations by name, in the sizes of pictures.

    Args:
        num_frames: number K of observations.
        temporal_positions: how frames are told apart, where there are outer blocks.
        **settings: further settings of the networks.
    """
    settings = PICTURE_TIT | settings
    ordered = {"temporal_positions": temporal_positions, **settings}
    return {
        "enhanced-tit": enhanced_tit(num_frames, **ordered),
        "enhanced-tit-wo-dense": enhanced_tit(num_frames, dense=False, **ordered),
        "enhanced-tit-wo-inner": enhanced_tit(num_frames, inner=False, **ordered),
        "enhanced-tit-wo-outer": enhanced_tit(num_frames, outer=False, **settings),
    }


_TIT: dict[str, Any] = {"patch_size": "auto", "patch_weights": "own"}


def reliable_tit(name: str, num_frames: int = 1, **settings: Any) -> Network:
    """Returns a TIT network that suits these settings.

    An array is one patch, which has a bias; for an image, "auto" chooses the patch size. If several
    frames are read, learned positions tell them apart.

    Args:
        name: enhanced-tit or vanilla-tit.
        num_frames: number K of observations.
        **settings: further settings of the network.
    """
    make = {"enhanced-tit": enhanced_tit, "vanilla-tit": vanilla_tit}[name]
    positions = {"temporal_positions": "learned"} if num_frames > 1 else {}
    return make(num_frames, **{**_TIT, **positions, **settings})
