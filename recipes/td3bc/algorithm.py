"""TD3 with a behaviour cloning term."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives import SoftUpdate, TD3BCLoss

from torchrl_tit.modules.action_specs import has_bounds

from ..algorithm import Stateful
from ..critics import make_critic
from ..policies import describe, make_deterministic_policy
from ..transition_algorithm import TransitionAlgorithm, descend, parameters_of
from .settings import TD3BC


class TD3BCAlgorithm(TransitionAlgorithm[TD3BC]):
    """TorchRL's TD3+BC losses, with a deterministic actor on a backbone and two critics.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task's actions are not continuous and bounded, or the critics cannot read
            its observations.
    """

    columns = ("loss_qvalue", "loss_actor", "loss_bc")

    def __init__(self, recipe: TD3BC) -> None:
        super().__init__(recipe)
        spec = self.action_spec
        if not has_bounds(spec):
            raise ValueError(
                f"td3bc needs continuous actions within bounds, but those of {recipe.env} are "
                f"{describe(spec)}: use a bc or iql recipe"
            )
        # TorchRL's loss hides keys from the critics that the actor does not declare: "observation".
        backbone = self.make_backbone(slices=True)
        self._policy = make_deterministic_policy(backbone, spec).to(self.device)
        critics = [
            make_critic(
                self.observation,
                spec.shape[0],
                recipe.critic_hidden,
                recipe.backbone if recipe.critic == "backbone" else None,
                slices=recipe.slice_length > 1,
                eps=self.eps,
            ).to(self.device)
            for _ in range(2)
        ]
        half_range = (spec.space.high - spec.space.low) / 2
        self.loss = TD3BCLoss(
            self._policy,
            critics,
            action_spec=spec,
            loss_function="l2",
            alpha=recipe.alpha,
            policy_noise=recipe.policy_noise * half_range,
            noise_clip=recipe.noise_clip * half_range,
            # On a CPU, two matrix products are faster than one batched product; slices cannot be
            # batched.
            deactivate_vmap=self.device.type == "cpu" or recipe.slice_length > 1,
        )
        self.loss.make_value_estimator(gamma=recipe.gamma)

    def prepare(self, step: int, folder: Path) -> None:
        """Builds optimizers, target update and replay buffer."""
        recipe, loss = self.recipe, self.loss
        adam = partial(torch.optim.Adam, fused=True)
        self.critic_optimizer = adam(
            parameters_of(loss.qvalue_network_params), lr=recipe.critic_learning_rate
        )
        self.actor_optimizer = adam(
            parameters_of(loss.actor_network_params), lr=recipe.actor_learning_rate
        )
        self.target = SoftUpdate(loss, tau=recipe.tau)
        self.buffer = self.make_buffer()
        self.actor_terms = nn.Module()
        """The actor's terms at its last update, which steps without an update report again."""
        self.actor_terms.register_buffer("values", torch.zeros(2, device=self.device))

    def state(self) -> Mapping[str, Stateful]:
        """Optimizers, the sampling state of the replay buffer, and the actor's last terms."""
        return {
            "critic_optimizer": self.critic_optimizer,
            "actor_optimizer": self.actor_optimizer,
            "buffer": self.buffer,
            "actor_terms": self.actor_terms,
        }

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor]:
        """Updates the critics, and every ``policy_delay`` steps the actor and the targets.

        A batch is transitions [B], or slices [N, T]. The actor's loss uses the critics after their
        update.
        """
        values = self.actor_terms.get_buffer("values")
        loss_qvalue, _ = self.loss.qvalue_loss(batch)
        descend(loss_qvalue, self.critic_optimizer)
        if step % self.recipe.policy_delay == 0:
            loss_actor, others = self.loss.actor_loss(batch)
            descend(loss_actor, self.actor_optimizer)
            self.target.step()
            values.copy_(torch.stack([loss_actor.detach(), others["bc_loss"]]))
        return self.named(torch.cat([loss_qvalue.detach().unsqueeze(0), values]))
