"""Implicit Q-learning."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import DiscreteIQLLoss, IQLLoss, SoftUpdate

from torchrl_tit.datasets import DatasetError, Episodes

from ..algorithm import Stateful
from ..critics import make_critic
from ..policies import describe, is_continuous, is_discrete, make_cloning_policy
from ..transition_algorithm import TransitionAlgorithm, parameters_of
from .settings import IQL

_RETURN_RANGE = 1000.0


class IQLAlgorithm(TransitionAlgorithm[IQL]):
    """TorchRL's IQL losses, with an actor on a backbone, two critics and a state value.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task's actions are neither arrays of floats nor a few discrete ones, or
            the value networks cannot read its observations.
    """

    clips_actions = True
    columns = ("loss_value", "loss_qvalue", "loss_actor", "nll")

    def __init__(self, recipe: IQL) -> None:
        super().__init__(recipe)
        spec = self.action_spec
        if not (is_continuous(spec) or is_discrete(spec)):
            raise ValueError(
                f"iql needs arrays of continuous actions or a few discrete ones, but those of "
                f"{recipe.env} are {describe(spec)}: use a bc recipe"
            )
        # TorchRL's loss hides keys from the critics that the actor does not declare: "observation".
        backbone = self.make_backbone(slices=True)
        self._policy = make_cloning_policy(backbone, spec).to(self.device)
        critics = [self._make_critic("state_action_value") for _ in range(2)]
        value = self._make_critic("state_value")
        make_loss = DiscreteIQLLoss if is_discrete(spec) else IQLLoss
        self.loss = make_loss(
            self._policy,
            critics,
            value,
            loss_function="l2",
            temperature=recipe.temperature,
            expectile=recipe.expectile,
            **({"action_space": "categorical"} if make_loss is DiscreteIQLLoss else {}),
        )
        if self.device.type == "cpu":  # two matrix products are faster there than a batched one
            self.loss.deactivate_vmap = True
            self.loss._make_vmap()
        self.loss.make_value_estimator(gamma=recipe.gamma)

    def prepare(self, step: int, folder: Path) -> None:
        """Builds optimizer, target update and replay buffer."""
        recipe, loss = self.recipe, self.loss
        values = (loss.qvalue_network_params, loss.value_network_params)
        groups = [
            {"params": parameters_of(loss.actor_network_params)},
            {"params": [p for params in values for p in parameters_of(params)]},
        ]
        self.optimizer = torch.optim.Adam(groups, lr=recipe.learning_rate, fused=True)
        self.target = SoftUpdate(loss, tau=recipe.tau)
        self.buffer = self.make_buffer()

    def state(self) -> Mapping[str, Stateful]:
        """Optimizer, and the sampling state of the replay buffer."""
        return {"optimizer": self.optimizer, "buffer": self.buffer}

    def load_data(self) -> Episodes:
        """As :meth:`TransitionAlgorithm.load_data`, with rewards scaled as in the paper.

        Raises:
            DatasetError: if rewards are to be scaled, but the returns of all episodes are the same.
        """
        episodes = super().load_data()
        if not self.recipe.normalize_rewards:
            return episodes
        returns = episodes.returns[episodes.finished.cpu()]
        spread = (returns.max() - returns.min()).item() if len(returns) else 0.0
        if not spread > 0:
            raise DatasetError(
                episodes.source,
                "normalize_rewards is on, but no two finished episodes differ in return: switch it "
                "off",
            )
        rows = episodes.rows.copy()
        rows["reward"] = rows["reward"] * (_RETURN_RANGE / spread)
        return replace(episodes, rows=rows)

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor]:
        """Updates value, critics and actor together, then the targets.

        A batch is transitions [B], or slices [N, T].
        """
        recipe = self.recipe
        if recipe.decay_learning_rate:
            fall = (1 + math.cos(math.pi * step / recipe.total_updates)) / 2
            self.optimizer.param_groups[0]["lr"] = recipe.learning_rate * fall
        losses = self.loss(batch)
        names = ("loss_value", "loss_qvalue", "loss_actor")
        # What TorchRL calls entropy is the data's negative log-likelihood.
        terms = torch.stack([losses[name].detach() for name in (*names, "entropy")])
        named = self.named(terms)
        self.optimizer.zero_grad()
        sum(losses[name] for name in names).backward()
        self.optimizer.step()
        self.target.step()
        return named

    def _make_critic(self, out_key: str) -> TensorDictModuleBase:
        """Builds a state value, or Q of the action or of each discrete action."""
        recipe, spec = self.recipe, self.action_spec
        discrete = is_discrete(spec)
        of_actions = out_key == "state_action_value"
        critic = make_critic(
            self.observation,
            spec.shape[0] if of_actions and not discrete else 0,
            recipe.critic_hidden,
            recipe.backbone if recipe.critic == "backbone" else None,
            values=spec.space.n if of_actions and discrete else 1,
            out_key=out_key,
            slices=recipe.slice_length > 1,
            eps=self.eps,
        )
        return critic.to(self.device)
