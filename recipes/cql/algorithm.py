"""Conservative Q-learning with continuous actions."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torchrl.objectives import SoftUpdate

from torchrl_tit.modules import make_squashed_actor
from torchrl_tit.modules.action_specs import has_bounds
from torchrl_tit.objectives import ContinuousCQLLoss, PolicySamples

from ..algorithm import Stateful
from ..compilation import compile_and_time
from ..critics import make_critic
from ..policies import describe
from ..transition_algorithm import descend, parameters_of
from .q_algorithm import QAlgorithm
from .settings import CQL

# For this many actions, the activations of critics with three layers of 256, 8 MB, fit into a CPU's
# cache.
_ACTIONS_IN_CACHE = 2000


class CQLAlgorithm(QAlgorithm[CQL]):
    """Actor on a backbone, two critics and a temperature, each with its own optimizer.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task's actions are not continuous and bounded, or the critics cannot read
            its observations.
    """

    compiles_on = ("cpu", "cuda")
    # The losses are in the order of the steps: the first that is not finite is the cause.
    columns = ("loss_alpha", "loss_qvalue", "loss_cql", "loss_actor", "alpha", "entropy")

    def __init__(self, recipe: CQL) -> None:
        super().__init__(recipe)
        spec = self.action_spec
        if not has_bounds(spec):
            raise ValueError(
                f"cql needs continuous actions within bounds, but those of {recipe.env} are "
                f"{describe(spec)}: use a discrete-cql recipe if they are discrete"
            )
        backbone = self.make_backbone()
        head = make_squashed_actor(backbone.features_dim, spec)
        self._policy = ProbabilisticTensorDictSequential(backbone, *head).to(self.device)
        network = recipe.backbone if recipe.critic == "backbone" else None
        critics = [
            make_critic(
                self.observation,
                spec.shape[0],
                recipe.critic_hidden,
                network,
                slices=recipe.slice_length > 1,
                eps=self.eps,
            )
            for _ in range(2)
        ]
        self.loss: ContinuousCQLLoss = ContinuousCQLLoss(
            self._policy,
            [critic.to(self.device) for critic in critics],
            action_spec=spec,
            min_q_weight=recipe.conservative_weight,
            num_random=recipe.action_samples,
            over_critics=recipe.over_critics,
            alpha_init=recipe.temperature_init,
            # On a CPU, two matrix products are faster than one batched product.
            deactivate_vmap=self.device.type == "cpu",
        )
        self.loss.make_value_estimator(gamma=recipe.gamma)

    def prepare(self, step: int, folder: Path) -> None:
        """Builds optimizers, target update and replay buffer."""
        recipe, loss = self.recipe, self.loss
        adam = partial(torch.optim.Adam, eps=recipe.adam_eps, fused=True)
        self.temperature_optimizer = adam([loss.log_alpha], lr=recipe.temperature_learning_rate)
        self.critic_optimizer = adam(
            parameters_of(loss.qvalue_network_params), lr=recipe.critic_learning_rate
        )
        self.actor_optimizer = adam(
            parameters_of(loss.actor_network_params), lr=recipe.actor_learning_rate
        )
        self.target = SoftUpdate(loss, tau=recipe.tau)
        self.buffer = self.make_buffer()
        self.chunk_size: int | None = None
        if self.device.type == "cpu":  # faster there: see ContinuousCQLLoss.critic_gradients
            self.chunk_size = max(1, _ACTIONS_IN_CACHE // (3 * recipe.action_samples + 1))
        self.sample_policy, self.critic_losses = loss.sample_policy, loss.critic_losses
        self.actor_loss = loss.actor_loss
        compiled = self.should_compile()
        if compiled:
            self.sample_policy = compile_and_time(loss.sample_policy, "the policy")
        if compiled and self.chunk_size is None:  # on a CPU, matrix products dominate
            self.critic_losses = compile_and_time(loss.critic_losses, "the critics' loss")
            self.actor_loss = compile_and_time(loss.actor_loss, "the actor's loss")

    def state(self) -> Mapping[str, Stateful]:
        """Optimizers, and the sampling state of the replay buffer."""
        return {
            "temperature_optimizer": self.temperature_optimizer,
            "critic_optimizer": self.critic_optimizer,
            "actor_optimizer": self.actor_optimizer,
            "buffer": self.buffer,
        }

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor]:
        """Updates temperature, critics, actor and targets, in this order.

        A batch is transitions [B], or slices [N, T].

        The actor runs once for all losses; the actor's loss uses the critics and the temperature
        after their updates, as in d3rlpy.
        """
        samples = self.sample_policy(batch)
        loss_alpha = self.loss.alpha_loss(samples)
        descend(loss_alpha, self.temperature_optimizer)
        self.critic_optimizer.zero_grad()
        loss_qvalue, loss_cql = self._critic_gradients(batch, samples)
        self.critic_optimizer.step()
        loss_actor, _ = self.actor_loss(batch, samples)
        descend(loss_actor, self.actor_optimizer)
        self.target.step()
        alpha, entropy = self.loss.log_alpha.exp(), -samples.log_prob.mean()
        terms = [loss_alpha, loss_qvalue, loss_cql, loss_actor, alpha, entropy]
        return self.named(torch.stack([term.detach() for term in terms]))

    def _critic_gradients(
        self, batch: TensorDictBase, samples: PolicySamples
    ) -> tuple[Tensor, Tensor]:
        """Adds the critics' gradients; returns their squared error and conservative term."""
        if self.chunk_size is not None:
            return self.loss.critic_gradients(batch, samples, self.chunk_size)
        loss_qvalue, loss_cql = self.critic_losses(batch, samples)
        (loss_qvalue + loss_cql).backward()
        return loss_qvalue, loss_cql
