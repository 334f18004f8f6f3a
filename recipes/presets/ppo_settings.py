"""The set of PPO settings with which transformers, and all other networks here, learn reliably.

docs/results/ppo_settings.md describes how it was found, what each setting does, and the results.
"""

from __future__ import annotations

from typing import Any

from torchrl_tit.settings import Network
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
    # An update ends once it has moved the policy this far; small minibatches often get there.
    "target_kl": 0.05,
}
"""Fields of the recipe; the others have their defaults, which are Stable-Baselines3's."""

STEADY_PPO_SETTINGS: dict[str, Any] = PPO_SETTINGS | {"minibatch_size": 256, "target_kl": 0.02}
"""The same with smaller and less noisy updates, for tasks that only a history solves."""

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
