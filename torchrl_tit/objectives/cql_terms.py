"""The inputs of the terms of continuous CQL."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from tensordict import TensorDictBase
from torch import Tensor


class PolicySamples(NamedTuple):
    """Samples that all terms of the loss share: one pass of the actor over a batch, at s and s'.

    States [*B], m samples of each distribution, A entries of an action.
    """

    action: Tensor
    """Sampled at s, differentiable; float [*B, A]."""
    log_prob: Tensor
    """Its log density, differentiable; float [*B]."""
    actions: Tensor
    """m samples at s, then m at s', detached; float [*B, 2m, A]."""
    log_probs: Tensor
    """Their log densities; float [*B, 2m]."""
    next_action: Tensor
    """The deterministic action at s' (the squashed mean), detached; float [*B, A]."""


@dataclass(frozen=True)
class CriticBatch:
    """The critics' inputs: states [*B] with 3m sampled actions each, and the action taken."""

    inputs: TensorDictBase
    """The critics' input entries; the actions are float [*B, 3m + 1, A], the action taken last."""
    log_density: Tensor
    """Log densities of the sampled actions; float [*B, 3m]."""
    target: Tensor
    """Target of the value of the action taken; float [*B]."""

    def split(self, size: int) -> list[CriticBatch]:
        """Splits the batch into chunks of ``size`` states, or fewer: whole slices, at least one."""
        size = max(1, size // math.prod(self.target.shape[1:]))
        fields = (self.inputs, self.log_density, self.target)
        chunks = zip(*(field.split(size) for field in fields), strict=True)
        return [CriticBatch(*chunk) for chunk in chunks]
