"""What the terms of continuous CQL are computed from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import CQLLoss


class PolicySamples(NamedTuple):
    """What one pass of the actor over a batch, at s and at s', gives to all terms of the loss.

    B states, n samples of each distribution, A entries of an action.
    """

    action: Tensor
    """Drawn at s, with a gradient to the actor; float [B, A]."""
    log_prob: Tensor
    """Its log density, with a gradient too; float [B]."""
    actions: Tensor
    """n drawn at s and n at s', without gradient; float [B, 2n, A]."""
    log_probs: Tensor
    """Their log densities; float [B, 2n]."""
    next_action: Tensor
    """The deterministic action at s' (tanh of the mean), without gradient; float [B, A]."""


class CQLWeights(NamedTuple):
    """All that is trained, and the delayed critics; two critics are stacked in front."""

    actor: TensorDictBase
    """Weights of the actor."""
    critics: TensorDictBase
    """Weights of the critics, [2, ...]."""
    target_critics: TensorDictBase
    """Weights of the critics that the target is computed with, [2, ...]."""
    log_alpha: Tensor
    """Logarithm of the temperature; float []."""

    @classmethod
    def of(cls, loss: CQLLoss) -> CQLWeights:
        """The weights in a loss."""
        return cls(
            loss.actor_network_params,
            loss.qvalue_network_params,
            loss.target_qvalue_network_params,
            loss.log_alpha,
        )


@dataclass(frozen=True)
class Questions:
    """What critics are asked of B states: values of 3n drawn actions in each, and of that taken."""

    inputs: TensorDictBase
    """What critics read; the actions are float [B, 3n + 1, A], that taken last."""
    log_density: Tensor
    """How likely the drawn actions were; float [B, 3n]."""
    target: Tensor
    """What the value of the action taken should be; float [B]."""

    def split(self, size: int) -> list[Questions]:
        """Splits the states."""
        fields = (self.inputs, self.log_density, self.target)
        return [Questions(*part) for part in zip(*(f.split(size) for f in fields), strict=True)]
