"""What was found to make TIT learn with PPO on arrays, by search: fields of a recipe as data."""

from __future__ import annotations

from typing import Any

# docs/results/classic_control.md says why. Environments side by side are for speed.
FOR_SPARSE_GOALS: dict[str, Any] = {
    "num_envs": 16,
    "steps_per_batch": 1024,
    "learning_rate": 2e-4,
    "gae_lambda": 0.98,
    "entropy_coeff": 0.01,
    "reward_scale": 0.1,
}
"""Fields of the recipe that learn to reach a goal that is seldom found."""

_FOR_SPARSE_GOALS_TIT = {"patch_size": 2, "activation_head": "relu"}

# docs/results/hopper.md says why. A patch is the whole observation.
_FOR_LOCOMOTION: dict[str, Any] = {
    "num_envs": 8,
    "decay_learning_rate": True,
    "critic_coeff": 0.02,
    "reward_scale": 0.1,
}

TUNED_TIT: dict[str, dict[str, Any]] = {
    "acrobot": {**FOR_SPARSE_GOALS, "backbone": _FOR_SPARSE_GOALS_TIT},
    "cartpole": {"num_envs": 8, "critic_coeff": 0.02},
    "mountaincar": {**FOR_SPARSE_GOALS, "backbone": _FOR_SPARSE_GOALS_TIT},
    "ant": {**_FOR_LOCOMOTION, "backbone": {"patch_size": 105}},
    "halfcheetah": {**_FOR_LOCOMOTION, "backbone": {"patch_size": 17}},
    "hopper": {**_FOR_LOCOMOTION, "backbone": {"patch_size": 11}},
    "walker2d": {**_FOR_LOCOMOTION, "backbone": {"patch_size": 17}},
}
"""By task: fields of the recipe, and of its backbone under "backbone"."""
