"""Implicit Q-learning: settings, then the algorithm."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.objectives import DiscreteIQLLoss, IQLLoss

from torchrl_tit.datasets import Episodes
from torchrl_tit.settings.numbers import Inside, Rate, Weight

from .core.algorithm import descend
from .core.networks import check_actions, is_continuous, is_discrete, make_cloning_policy
from .offline import ActorCriticRecipe, TransitionAlgorithm


@dataclass(frozen=True, kw_only=True)
class IQL(ActorCriticRecipe, algorithm="iql"):
    """Implicit Q-learning (arXiv 2110.06169), with continuous or discrete actions.

    The defaults are those of the paper for MuJoCo.
    """

    learning_rate: Rate = 3e-4
    """Learning rate of Adam for all networks."""
    decay_learning_rate: bool = True
    """Whether the actor's learning rate decays to 0 on a cosine schedule."""
    expectile: Inside = 0.7
    """Expectile of Q(s, a) over the data's actions that V(s) estimates; 0.5 is the mean."""
    temperature: Weight = 3.0
    """Inverse temperature of the weights exp(temperature * advantage) of the actor's loss."""
    normalize_rewards: bool = True
    """Whether rewards are divided by the range of the whole episodes' returns and multiplied by the
    length of the longest, which is 1000 in the paper's data of MuJoCo. The temperature assumes
    advantages of that scale."""

    def build(self) -> IQLAlgorithm:
        """Builds the algorithm."""
        return IQLAlgorithm(self)

    @property
    def schedules(self) -> tuple[str, ...]:
        """The actor's learning rate, if it decays to 0."""
        return ("decay_learning_rate",) if self.decay_learning_rate else ()


class IQLAlgorithm(TransitionAlgorithm[IQL]):
    """TorchRL's IQL losses, with an actor on a backbone, two critics and a state value.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task's actions are neither arrays of floats nor a few discrete ones, or
            the value networks cannot read its observations.
    """

    clips_actions = True
    rates: ClassVar = {"actor_network": "learning_rate", "": "learning_rate"}  # the first decays
    columns = ("loss_value", "loss_qvalue", "loss_actor", "nll")
    measures = ("action_error", "q", "advantage", "nll")

    def networks(self, env: EnvBase) -> nn.Module:
        """Builds the loss with policy, critics, their targets and the state value."""
        recipe, spec = self.recipe, self.action_spec
        fit = is_continuous(spec) or is_discrete(spec)
        needed = "arrays of continuous actions or a few discrete ones"
        check_actions(recipe, spec, fit, needed, "a bc recipe")
        # TorchRL's loss hides keys from the critics that the actor does not declare: "observation".
        backbone = self.make_backbone(env, slices=True)
        self._policy = make_cloning_policy(backbone, spec).to(self.device)
        # A critic values one action, or each discrete one.
        discrete = is_discrete(spec)
        action, values = (None, spec.space.n) if discrete else (spec, 1)
        critics = [self.make_critic(env, action, values=values) for _ in range(2)]
        value = self.make_critic(env, None, out_key="state_value")
        discrete_only = {"action_space": "categorical"} if discrete else {}
        make_loss = DiscreteIQLLoss if discrete else IQLLoss
        loss = make_loss(
            self._policy,
            critics,
            value,
            loss_function="l2",
            temperature=recipe.temperature,
            expectile=recipe.expectile,
            **discrete_only,
        )
        if recipe.backbone.carries_state:  # vmap cannot map over an LSTM
            loss.deactivate_vmap = True  # DiscreteIQLLoss takes no such argument
            loss._make_vmap()
        loss.make_value_estimator(gamma=recipe.gamma)
        return loss

    def load_data(self) -> Episodes:
        """As :meth:`TransitionAlgorithm.load_data`, with rewards scaled."""
        episodes = super().load_data()
        if not self.recipe.normalize_rewards:
            return episodes
        whole = episodes.is_whole
        returns = episodes.returns[whole]
        if len(returns.unique()) < 2:
            warnings.warn(
                f"{episodes.source}: no two whole episodes differ in return, so rewards are not "
                "normalized",
                stacklevel=2,
            )
            return episodes
        longest = episodes.lengths[whole].max()
        rows = episodes.rows.copy()
        rows["reward"] = rows["reward"] * (longest / (returns.max() - returns.min()))
        return replace(episodes, rows=rows)

    def loss(self, samples: TensorDictBase) -> TensorDictBase:
        """Returns the terms of the loss; see :meth:`TransitionAlgorithm.loss`."""
        # What TorchRL calls entropy is the data's negative log-likelihood.
        return self.model(samples).rename_key_("entropy", "nll")

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor]:
        """Updates value, critics and actor together, then the targets.

        A batch is transitions [B], or slices [N, T].
        """
        recipe = self.recipe
        if recipe.decay_learning_rate:
            fall = (1 + math.cos(math.pi * step / recipe.total_updates)) / 2
            self.optimizer.param_groups[0]["lr"] = recipe.learning_rate * fall
        terms = self._loss(batch)
        descend(terms, self.optimizer)
        self.target.step()
        return self.numbers(terms)

    def measure_batch(self, samples: TensorDictBase) -> Mapping[str, Tensor]:
        """Adds the negative log-likelihood of the data's actions, in nats."""
        return {**super().measure_batch(samples), "nll": self.loss(samples.copy())["nll"]}
