"""Behaviour cloning."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_tit.objectives import LikelihoodBCLoss

from ..algorithm import Stateful
from ..policies import make_cloning_policy
from ..transition_algorithm import TransitionAlgorithm
from .settings import BC


class BCAlgorithm(TransitionAlgorithm[BC]):
    """A policy on a backbone, with a head for the task's actions.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if there is no head for the task's actions.
    """

    clips_actions = True
    columns = ("loss_bc",)

    def __init__(self, recipe: BC) -> None:
        super().__init__(recipe)
        policy = make_cloning_policy(self.make_backbone(), self.action_spec)
        self._policy = policy.to(self.device)
        self.loss = LikelihoodBCLoss(self._policy)

    def prepare(self, step: int, folder: Path) -> None:
        """Builds optimizer and replay buffer."""
        self.optimizer = torch.optim.Adam(
            self.loss.parameters(), lr=self.recipe.learning_rate, fused=True
        )
        self.buffer = self.make_buffer()

    def state(self) -> Mapping[str, Stateful]:
        """Optimizer, and the sampling state of the replay buffer."""
        return {"optimizer": self.optimizer, "buffer": self.buffer}

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor]:
        """Takes a step on transitions [B] or slices [N, T]."""
        loss = self.loss(batch)["loss_bc"]
        terms = self.named(loss.detach().unsqueeze(0))
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return terms
