"""SAC with any backbone: act, store transitions, and take gradient steps on samples of them."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    NormalParamExtractor,
    TensorDictSequential,
    set_skip_existing,
)
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_tit.modules import Backbone
from torchrl_tit.modules.action_specs import has_bounds
from torchrl_tit.modules.tensor_module import TensorModule
from torchrl_tit.objectives import encode_pairs

from ..critics import make_critic
from ..policies import describe
from ..replay_algorithm import ReplayAlgorithm
from .settings import SAC


class SACAlgorithm(ReplayAlgorithm[SAC]):
    """Soft actor-critic on TorchRL's loss, collector and replay buffer.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task's actions are not continuous and bounded, or the critics cannot read
            its observations.
    """

    columns = ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy")
    optional_columns = columns  # nothing is learned during the random steps

    def __init__(self, recipe: SAC) -> None:
        super().__init__(recipe)
        spec = self.action_spec
        if not has_bounds(spec):
            raise ValueError(
                f"sac needs continuous actions within bounds, but {recipe.env} has "
                f"{describe(spec)} actions: use a ppo recipe"
            )
        self._policy = _make_actor(self.make_backbone(), spec).to(self.device)
        size = spec.shape[0]
        # Two critics keep their initial weights; TorchRL would copy a single one and re-initialise
        # the copy.
        critics = [
            make_critic(
                self.observation,
                size,
                recipe.critic_hidden,
                recipe.critic_backbone,
                slices=recipe.slice_length > 1,
            ).to(self.device)
            for _ in range(2)
        ]
        self.loss = SACLoss(self._policy, critics, loss_function="l2", target_entropy=-float(size))
        self.loss.make_value_estimator(gamma=recipe.gamma)

    def prepare(self, step: int, folder: Path) -> None:
        """Builds optimizer, target update, collector and replay buffer."""
        recipe = self.recipe
        self.optimizer = torch.optim.Adam(
            self.loss.parameters(), lr=recipe.learning_rate, fused=True
        )
        self.target = SoftUpdate(self.loss, tau=recipe.tau)
        super().prepare(step, folder)

    def _step(self, batch: TensorDictBase, number: int) -> Tensor:
        """Takes a gradient step on transitions [B] or slices [N, T]; returns its terms."""
        actor = self.loss.actor_network
        with self.loss.actor_network_params.to_module(actor, preserve_module_state=False):
            pairs = encode_pairs(actor, batch)
        for group, features in zip((batch, batch["next"]), pairs, strict=True):
            group.update(features)
        with set_skip_existing(True):  # of the actor's backbone
            terms = self.loss(batch)
        self.optimizer.zero_grad()
        (terms["loss_actor"] + terms["loss_qvalue"] + terms["loss_alpha"]).backward()
        self.optimizer.step()
        self.target.step()
        return torch.stack([terms[name].detach() for name in self.columns])


def _make_actor(backbone: Backbone, action_spec: Bounded) -> ProbabilisticActor:
    """A tanh-squashed Gaussian on a backbone's features, with a linear head."""
    head = nn.Sequential(
        nn.Linear(backbone.features_dim, 2 * action_spec.shape[0]), NormalParamExtractor()
    )
    return ProbabilisticActor(
        TensorDictSequential(
            backbone, TensorModule(head, backbone.features_keys, ["loc", "scale"])
        ),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": action_spec.space.low, "high": action_spec.space.high},
    )
