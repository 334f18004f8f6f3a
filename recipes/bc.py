"""Behavior cloning: settings, then the algorithm."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from torchrl_tit.datasets import Episodes, select_episodes
from torchrl_tit.objectives import LikelihoodBCLoss
from torchrl_tit.settings.numbers import Rate, Share, Steps

from .core.algorithm import descend
from .core.networks import make_cloning_policy
from .offline import TransitionAlgorithm, TransitionRecipe


@dataclass(frozen=True, kw_only=True)
class BC(TransitionRecipe, algorithm="bc"):
    """Behavior cloning: maximizes the likelihood of a data set's actions, of any kind."""

    learning_rate: Rate = 3e-4
    """Learning rate of Adam."""
    best_fraction: Share = 1.0
    """Share of the whole episodes, finished and not cut at a gap, that are learned from: those with
    the highest returns (filtered behavior cloning, as in arXiv 2106.01345)."""
    time_limits: Literal["keep", "drop"] = "keep"
    """Whether to keep the last transition of an episode that a time limit truncated."""
    unfinished: Literal["keep", "drop"] = "keep"
    """Whether to keep the last episode if the data stop before it ends."""
    evaluation_interval: Steps = 5000
    """Gradient steps between evaluations."""

    def build(self) -> BCAlgorithm:
        """Builds the algorithm."""
        return BCAlgorithm(self)


class BCAlgorithm(TransitionAlgorithm[BC]):
    """A policy on a backbone, with a head for the task's actions.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if there is no head for the task's actions.
    """

    clips_actions = True
    columns = ("loss_bc",)
    measures = ("action_error", "log_likelihood")

    def networks(self, env: EnvBase) -> nn.Module:
        """Builds the loss with the policy."""
        policy = make_cloning_policy(self.make_backbone(env), self.action_spec)
        self._policy = policy.to(self.device)
        return LikelihoodBCLoss(self._policy)

    def split(self, episodes: Episodes) -> Episodes:
        """Leaves out all but the best episodes, and holds some of the best out."""
        if (fraction := self.recipe.best_fraction) < 1:
            whole = episodes.whole
            order = whole[episodes.returns[whole].argsort(descending=True, stable=True)]
            best = order[: max(1, round(fraction * len(order)))]
            episodes = select_episodes(episodes, best)
        return super().split(episodes)

    def loss(self, samples: TensorDictBase) -> TensorDictBase:
        """Returns the terms of the loss; see :meth:`TransitionAlgorithm.loss`."""
        return self.model(samples)

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor]:
        """Takes a gradient step on transitions [B] or slices [N, T]."""
        terms = self._loss(batch)
        descend(terms, self.optimizer)
        return self.numbers(terms)

    def measure_batch(self, samples: TensorDictBase) -> Mapping[str, Tensor]:
        """Adds the mean log-likelihood of the data's actions, in nats."""
        return {
            **super().measure_batch(samples),
            "log_likelihood": -self.model(samples)["loss_bc"],
        }
