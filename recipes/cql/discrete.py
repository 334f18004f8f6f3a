"""Conservative Q-learning with discrete actions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import SoftUpdate

from torchrl_tit.objectives import DelayedDiscreteCQLLoss

from ..algorithm import Stateful
from ..compilation import compile_and_time
from ..policies import describe, is_discrete, make_value_policy
from ..transition_algorithm import parameters_of
from .q_algorithm import QAlgorithm
from .settings import DiscreteCQL


class DiscreteCQLAlgorithm(QAlgorithm[DiscreteCQL]):
    """A value for each action, on a backbone.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task's actions are not discrete.
    """

    compiles_on = ("cuda",)
    columns = ("loss_qvalue", "loss_cql", "value")

    def __init__(self, recipe: DiscreteCQL) -> None:
        super().__init__(recipe)
        spec = self.action_spec
        if not is_discrete(spec):
            raise ValueError(
                f"discrete-cql needs a few discrete actions, but those of {recipe.env} are "
                f"{describe(spec)}: use a cql recipe if they are continuous"
            )
        self._policy = make_value_policy(self.make_backbone(), spec).to(self.device)
        self.loss = DelayedDiscreteCQLLoss(self._policy, action_space="categorical")
        self.loss.make_value_estimator(gamma=recipe.gamma)

    def prepare(self, step: int, folder: Path) -> None:
        """Builds optimizer, target update and replay buffer."""
        recipe, loss = self.recipe, self.loss
        self.optimizer = torch.optim.Adam(
            parameters_of(loss.value_network_params),
            lr=recipe.learning_rate,
            eps=recipe.adam_eps,
            fused=True,
        )
        self.target = SoftUpdate(loss, tau=recipe.tau)
        self.buffer = self.make_buffer()
        self.objective = loss.forward
        if self.should_compile():
            self.objective = compile_and_time(loss.forward, "the loss")

    def state(self) -> Mapping[str, Stateful]:
        """Optimizer, and the sampling state of the replay buffer."""
        return {"optimizer": self.optimizer, "buffer": self.buffer}

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor]:
        """Updates the values, then the target network, on transitions [B] or slices [N, T]."""
        losses = self.objective(batch)
        names = ("loss_qvalue", "loss_cql", "pred_value")
        terms = self.named(torch.stack([losses[name].detach() for name in names]))
        self.optimizer.zero_grad()
        (losses["loss_qvalue"] + self.recipe.conservative_weight * losses["loss_cql"]).backward()
        self.optimizer.step()
        self.target.step()
        return terms
