"""TD3 with a behavior cloning term: settings, then the algorithm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.objectives import TD3BCLoss

from torchrl_tit.modules.action_specs import half_range, has_bounds
from torchrl_tit.settings.numbers import Rate, Steps, Weight

from .core.algorithm import Stateful, Terms, descend
from .core.networks import check_actions, make_deterministic_policy
from .offline import ActorCriticRecipe, TransitionAlgorithm, action_values


@dataclass(frozen=True, kw_only=True)
class TD3BC(ActorCriticRecipe, algorithm="td3bc"):
    """TD3 with a behavior cloning term (arXiv 2106.06860), with the paper's defaults."""

    normalize_observations: bool = True
    """Whether to normalize observations by their mean and standard deviation in the data; only for
    arrays of floats."""
    actor_learning_rate: Rate = 3e-4
    """Learning rate of Adam for the actor."""
    critic_learning_rate: Rate = 3e-4
    """Learning rate of Adam for the critics."""
    alpha: Weight = 2.5
    """Weight of the value in the actor's loss, relative to the behavior cloning term."""
    policy_delay: Steps = 2
    """Gradient steps of the critics for each update of the actor and the targets."""
    policy_noise: Weight = 0.2
    """Standard deviation of the noise on the target's actions; 1 is half the range of actions."""
    noise_clip: Weight = 0.5
    """Largest absolute value of that noise; 1 is half the range of actions."""

    def build(self) -> TD3BCAlgorithm:
        """Builds the algorithm."""
        return TD3BCAlgorithm(self)


class TD3BCAlgorithm(TransitionAlgorithm[TD3BC]):
    """TorchRL's TD3+BC losses, with a deterministic actor on a backbone and two critics.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task's actions are not continuous and bounded, or the critics cannot read
            its observations.
    """

    columns = ("loss_qvalue", "loss_actor", "loss_bc")
    rates: ClassVar = {"qvalue_network": "critic_learning_rate", "": "actor_learning_rate"}
    model: TD3BCLoss

    def networks(self, env: EnvBase) -> nn.Module:
        """Builds the loss with policy, critics and their targets."""
        recipe, spec = self.recipe, self.action_spec
        instead = "a bc or iql recipe"
        check_actions(recipe, spec, has_bounds(spec), "continuous actions within bounds", instead)
        # TorchRL's loss hides keys from the critics that the actor does not declare: "observation".
        backbone = self.make_backbone(env, slices=True)
        self._policy = make_deterministic_policy(backbone, spec).to(self.device)
        self.half_range = half_range(spec).to(self.device)
        loss = TD3BCLoss(
            self._policy,
            [self.make_critic(env, spec) for _ in range(2)],
            action_spec=spec,
            loss_function="l2",
            alpha=recipe.alpha,
            policy_noise=recipe.policy_noise * self.half_range,
            noise_clip=recipe.noise_clip * self.half_range,
            deactivate_vmap=recipe.slice_length > 1,  # which it cannot map over
        )
        loss.make_value_estimator(gamma=recipe.gamma)
        return loss

    def prepare(self, step: int, folder: Path) -> None:
        """As :meth:`TransitionAlgorithm.prepare`, with the terms of the actor's last update."""
        super().prepare(step, folder)
        self._actor_loss = self.compiled(self.actor_loss, "the actor's loss")
        self.actor_terms = nn.Module()
        """The actor's terms at its last update, which steps without an update report again."""
        self.actor_terms.register_buffer("values", torch.zeros(2, device=self.device))

    def state(self) -> Mapping[str, Stateful]:
        """Optimizer, the sampling state of the replay buffer, and the actor's last terms."""
        return {**super().state(), "actor_terms": self.actor_terms}

    def loss(self, samples: TensorDictBase) -> Terms:
        """Returns the terms of the critics; see :meth:`TransitionAlgorithm.loss`."""
        return {"loss_qvalue": self.model.qvalue_loss(samples)[0]}

    def actor_loss(self, samples: TensorDictBase) -> Terms:
        """Returns the terms of the actor, once the critics have taken a step on theirs.

        The behavior cloning term counts actions in half ranges, as the noise does. TorchRL's counts
        them in units of the task, whose choice then decides how much the value matters.
        """
        loss = self.model
        policy, critic = loss.actor_network, loss.qvalue_network
        with loss.actor_network_params.to_module(policy, preserve_module_state=False):
            chosen = policy(samples.select(*policy.in_keys, strict=False))["action"]
        first, *_ = loss.qvalue_network_params.data.unbind(0)
        with first.to_module(critic, preserve_module_state=False):
            values = action_values(critic, samples, chosen)
        bc_loss = ((chosen - samples["action"]) / self.half_range).square().mean()
        weight = loss.alpha / values.abs().mean().detach()
        return {"loss_actor": bc_loss - weight * values.mean(), "bc_loss": bc_loss.detach()}

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor]:
        """Updates the critics, and every ``policy_delay`` steps the actor and the targets.

        A batch is transitions [B], or slices [N, T].
        """
        terms, values = dict(self._loss(batch)), self.actor_terms.get_buffer("values")
        descend(terms, self.optimizer)
        if step % self.recipe.policy_delay == 0:
            actor_terms = self._actor_loss(batch)
            descend(actor_terms, self.optimizer)
            self.target.step()
            values.copy_(torch.stack([actor_terms["loss_actor"], actor_terms["bc_loss"]]).detach())
        return self.numbers({**terms, **dict(zip(self.columns[1:], values, strict=True))})
