"""Conservative Q-learning with any network, with continuous and with discrete actions.

For each of the two, settings first, then the algorithm. To change one, subclass both and override
one of ``networks`` and ``loss``, or ``actor_loss``: docs/how-to/change-sac-dqn-cql.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn
from torchrl.envs import EnvBase

from torchrl_tit.modules import make_squashed_actor
from torchrl_tit.modules.action_specs import has_bounds
from torchrl_tit.objectives import ContinuousCQLLoss, DelayedDiscreteCQLLoss
from torchrl_tit.settings.numbers import (
    Count,
    Fraction,
    Positive,
    Rate,
    StepsOrNone,
    Weight,
    Widths,
)

from .core.algorithm import Terms, descend
from .core.networks import check_actions, is_discrete, make_value_policy, target_entropy
from .offline import TransitionAlgorithm, TransitionRecipe


@dataclass(frozen=True, kw_only=True)
class ConservativeRecipe(TransitionRecipe):
    """Settings of conservative Q-learning with continuous and with discrete actions."""

    removed: ClassVar[dict[str, Any]] = {
        "adam_eps": 1e-8,
        "temperature_init": 1.0,
        "terminal_observations": "zero",
    }

    gamma: Fraction = 0.99
    """Discount factor."""
    tau: Fraction = 0.005
    """Coefficient of the soft update of the target networks at each gradient step, from 0 to 1."""
    conservative_weight: Weight = 5.0
    """Weight of the conservative term."""


@dataclass(frozen=True, kw_only=True)
class CQL(ConservativeRecipe, algorithm="cql"):
    """Conservative Q-learning (arXiv 2006.04779) on a data set with continuous actions.

    The defaults are those of d3rlpy 1.1.1, with which arXiv 2212.14538 trained CQL_TIT.
    """

    actor_learning_rate: Rate = 1e-4
    """Learning rate of Adam for the actor."""
    critic_learning_rate: Rate = 3e-4
    """Learning rate of Adam for the critics."""
    temperature_learning_rate: Rate = 1e-4
    """Learning rate of Adam for the temperature."""
    alpha_init: Positive = 1.0
    """Initial temperature."""
    cloning_updates: StepsOrNone = 0
    """Gradient steps at the start in which the actor imitates the data's actions, while the critics
    learn; 40,000 of 1,000,000 in the code of arXiv 2006.04779."""
    action_samples: Count = 10
    """Actions sampled in each state from each of: uniform, the policy at s, the policy at s'."""
    over_critics: Literal["mean", "sum"] = "mean"
    """Whether the conservative term is the mean over the two critics, as in d3rlpy 1.1.1, or their
    sum, as in d3rlpy since 2.5."""
    critic: Literal["mlp", "backbone"] = "mlp"
    """Whether the critics read the newest observation, or each has a backbone with the actor's
    settings."""
    critic_hidden: Widths = (256, 256, 256)
    """Widths of the critics' hidden layers."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0 < self.total_updates <= self.cloning_updates:
            raise ValueError(
                f"cloning_updates is {self.cloning_updates}, so an actor of {self.total_updates} "
                "updates (total_updates) only imitates the data: raise total_updates, or lower "
                "cloning_updates"
            )

    def build(self) -> CQLAlgorithm:
        """Builds the algorithm."""
        return CQLAlgorithm(self)


class CQLAlgorithm(TransitionAlgorithm[CQL]):
    """Actor on a backbone, two critics and a temperature.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task's actions are not continuous and bounded, or the critics cannot read
            its observations.
    """

    # The losses are in the order of the steps: the first that is not finite is the cause.
    columns = ("loss_alpha", "loss_qvalue", "loss_cql", "loss_actor", "alpha", "entropy")
    measures = ("action_error", "q", "advantage", "loss_cql")
    terminal_observations = "zero"  # as in d3rlpy 1.1.1
    rates: ClassVar = {
        "log_alpha": "temperature_learning_rate",
        "qvalue_network": "critic_learning_rate",
        "": "actor_learning_rate",
    }
    model: ContinuousCQLLoss

    def networks(self, env: EnvBase) -> nn.Module:
        """Builds the loss with policy, critics, their targets and the temperature."""
        recipe, spec = self.recipe, self.action_spec
        instead = "a discrete-cql recipe if they are discrete"
        check_actions(recipe, spec, has_bounds(spec), "continuous actions within bounds", instead)
        backbone = self.make_backbone(env)
        head = make_squashed_actor(backbone.features_dim, spec)
        self._policy = ProbabilisticTensorDictSequential(backbone, *head).to(self.device)
        loss = ContinuousCQLLoss(
            self._policy,
            [self.make_critic(env, spec) for _ in range(2)],
            action_spec=spec,
            min_q_weight=recipe.conservative_weight,
            num_random=recipe.action_samples,
            over_critics=recipe.over_critics,
            alpha_init=recipe.alpha_init,
            target_entropy=target_entropy(spec),
        )
        loss.make_value_estimator(gamma=recipe.gamma)
        return loss

    def prepare(self, step: int, folder: Path) -> None:
        """As :meth:`TransitionAlgorithm.prepare`; also compiles the actor's part, if that pays."""
        super().prepare(step, folder)
        self._sample_policy = self.compiled(self.model.sample_policy, "the policy")
        self._actor_loss = self.compiled(self.actor_loss, "the actor's loss")
        self._cloning_loss = self.compiled(self.cloning_loss, "the actor's cloning loss")

    def loss(self, samples: TensorDictBase) -> Terms:
        """Returns the terms of critics and temperature; see :meth:`TransitionAlgorithm.loss`.

        Args:
            samples: transitions [B] or slices [N, T], with the actions that the policy drew: see
                :meth:`~torchrl_tit.objectives.ContinuousCQLLoss.sample_policy`.
        """
        terms = self.model.critic_loss(samples)
        return {
            "loss_alpha": self.model.alpha_loss(samples)[0],
            "loss_qvalue": terms["loss_qvalue"],
            "loss_cql": terms["loss_cql"],
        }

    def actor_loss(self, samples: TensorDictBase) -> Terms:
        """Returns the terms of the actor, once the others have taken a step on theirs.

        Whatever trains the actor's weights belongs here, once ``cloning_updates`` are over.

        Args:
            samples: as in :meth:`loss`.
        """
        return self._actor_terms(self.model.actor_loss(samples)[0], samples)

    def cloning_loss(self, samples: TensorDictBase) -> Terms:
        """Returns the terms of the actor in the first ``cloning_updates``."""
        return self._actor_terms(self.model.actor_bc_loss(samples)[0], samples)

    def _actor_terms(self, loss_actor: Tensor, samples: TensorDictBase) -> Terms:
        log_prob = samples["policy_samples", "log_prob"].detach()
        return {
            "loss_actor": loss_actor,
            "alpha": self.model.log_alpha.detach().exp(),
            "entropy": -log_prob.mean(),
        }

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor]:
        """Updates temperature and critics, then the actor, then the targets.

        The actor runs once for all losses. Its own loss uses the critics and the temperature after
        their updates, as in d3rlpy.
        """
        samples = self._sample_policy(batch)
        terms = self._loss(samples)
        descend(terms, self.optimizer)
        clones = step < self.recipe.cloning_updates
        actor_terms = (self._cloning_loss if clones else self._actor_loss)(samples)
        descend(actor_terms, self.optimizer)
        self.target.step()
        return self.numbers({**terms, **actor_terms})

    def measure_batch(self, samples: TensorDictBase) -> Mapping[str, Tensor]:
        """Adds the conservative term, the gap between the critics' values."""
        loss_cql = self.loss(self.model.sample_policy(samples))["loss_cql"]
        return {**super().measure_batch(samples), "loss_cql": loss_cql}


@dataclass(frozen=True, kw_only=True)
class DiscreteCQL(ConservativeRecipe, algorithm="discrete-cql"):
    """Conservative Q-learning (arXiv 2006.04779) with a value for each action, and TorchRL's loss.

    The squared error is halved, as in TorchRL. The paper ran no discrete task offline.
    """

    conservative_weight: Weight = 1.0
    """Weight of the conservative term."""
    learning_rate: Rate = 3e-4
    """Learning rate of Adam."""

    def build(self) -> DiscreteCQLAlgorithm:
        """Builds the algorithm."""
        return DiscreteCQLAlgorithm(self)


class DiscreteCQLAlgorithm(TransitionAlgorithm[DiscreteCQL]):
    """A value for each action, on a backbone.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task's actions are not discrete.
    """

    columns = ("loss_qvalue", "loss_cql", "value")
    measures = ("action_error", "loss_cql", "value")
    terminal_observations = "zero"  # as d3rlpy 1.1.1 for continuous actions
    model: DelayedDiscreteCQLLoss

    def networks(self, env: EnvBase) -> nn.Module:
        """Builds the loss with the network of the values, the policy, and its target."""
        recipe, spec = self.recipe, self.action_spec
        instead = "a cql recipe if they are continuous"
        check_actions(recipe, spec, is_discrete(spec), "a few discrete actions", instead)
        self._policy = make_value_policy(self.make_backbone(env), spec).to(self.device)
        loss = DelayedDiscreteCQLLoss(self._policy, action_space="categorical")
        loss.make_value_estimator(gamma=recipe.gamma)
        return loss

    def loss(self, samples: TensorDictBase) -> Terms:
        """Returns the terms of the loss; see :meth:`TransitionAlgorithm.loss`."""
        terms = self.model(samples)
        values = samples[self.model.tensor_keys.pred_val]  # "pred_value" averages all actions
        return {
            "loss_qvalue": terms["loss_qvalue"],
            "loss_cql": self.recipe.conservative_weight * terms["loss_cql"],
            "value": values.gather(-1, samples["action"].unsqueeze(-1)).mean(),
        }

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor]:
        """Updates the values, then the target network, on transitions [B] or slices [N, T]."""
        terms = self._loss(batch)
        descend(terms, self.optimizer)
        self.target.step()
        return self.numbers(terms)

    def measure_batch(self, samples: TensorDictBase) -> Mapping[str, Tensor]:
        """Compares actions, and adds the conservative term and the value of the data's actions."""
        terms = self.loss(samples.copy())
        error = super().measure_batch(samples)
        return {**error, "loss_cql": terms["loss_cql"], "value": terms["value"]}
