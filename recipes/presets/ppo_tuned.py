"""Settings with which TIT learns with PPO on arrays, found by search."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from torchrl_tit.settings import Activation, Inner, Network

# docs/results/classic_control.md says why. Several environments are for speed.
FOR_SPARSE_GOALS: dict[str, Any] = {
    "num_envs": 16,
    "steps_per_batch": 1024,
    "learning_rate": 2e-4,
    "gae_lambda": 0.98,
    "entropy_coeff": 0.01,
    "reward_scale": 0.1,
}
"""Fields of the recipe for tasks whose goal is seldom reached."""

# docs/results/hopper.md says why.
_FOR_LOCOMOTION: dict[str, Any] = {
    "num_envs": 8,
    "decay_learning_rate": True,
    "critic_coeff": 0.02,
    "reward_scale": 0.1,
}


@dataclass(frozen=True)
class Tuned:
    """Settings in which a task's tuned recipe differs from the protocol."""

    fields: dict[str, Any]
    """Fields of the recipe."""
    patch_size: int | None = 1
    """Entries of a patch; the whole observation if None."""
    activation_head: Activation = "tanh"
    """Activation of the head."""

    def adapt(self, network: Network) -> Network:
        """Returns a TIT network with the tuned patch and head."""
        assert isinstance(network.frame, Inner)
        return replace(
            network,
            frame=replace(network.frame, patch_size=self.patch_size),
            head=replace(network.head, activation=self.activation_head),
        )


TUNED_TIT: dict[str, Tuned] = {
    "acrobot": Tuned(FOR_SPARSE_GOALS, patch_size=2, activation_head="relu"),
    "cartpole": Tuned({"num_envs": 8, "critic_coeff": 0.02}),
    "mountaincar": Tuned(FOR_SPARSE_GOALS, patch_size=2, activation_head="relu"),
    "ant": Tuned(_FOR_LOCOMOTION, patch_size=105),
    "halfcheetah": Tuned(_FOR_LOCOMOTION, patch_size=17),
    "hopper": Tuned(_FOR_LOCOMOTION, patch_size=11),
    "walker2d": Tuned(_FOR_LOCOMOTION, patch_size=17),
}
"""By task."""
