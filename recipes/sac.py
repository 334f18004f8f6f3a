"""SAC with any network: act, store the steps, and take gradient steps on samples of them.

Settings first, then the algorithm. To change it, subclass both and override one of ``networks``,
``collected`` and ``loss``: docs/how-to/change-sac-dqn-cql.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictSequential
from torch import nn
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_tit.modules.action_specs import has_bounds
from torchrl_tit.modules.tensor_module import TensorModule
from torchrl_tit.settings import Network
from torchrl_tit.settings.numbers import Fraction, Rate, Widths

from .core.algorithm import Terms, descend
from .core.networks import check_actions, target_entropy
from .replay import ReplayAlgorithm, ReplayRecipe


@dataclass(frozen=True, kw_only=True)
class SAC(ReplayRecipe, algorithm="sac"):
    """Soft actor-critic (arXiv 1812.05905) with two critics and a learned temperature."""

    learning_rate: Rate = 3e-4
    """Learning rate of Adam for actor, critics and temperature."""
    tau: Fraction = 0.005
    """Coefficient of the soft update of the target critics at each gradient step, from 0 to 1."""
    critic: Literal["auto", "mlp", "backbone"] = "auto"
    """Whether the critics read the newest observation, or each has a backbone with the actor's
    settings, which reads the history. "auto" takes the backbone if velocities are hidden, because
    one observation is then not enough, else the newest observation."""
    critic_hidden: Widths = (256, 256)
    """Widths of the critics' hidden layers."""

    def build(self) -> SACAlgorithm:
        """Builds the algorithm."""
        return SACAlgorithm(self)

    @property
    def critic_backbone(self) -> Network | None:
        """As :attr:`SamplesRecipe.critic_backbone`, also if "auto" takes it."""
        hidden = self.critic == "auto" and self.hide_velocities
        return self.backbone if hidden else super().critic_backbone


class SACAlgorithm(ReplayAlgorithm[SAC]):
    """Soft actor-critic on TorchRL's loss, collector and replay buffer.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task's actions are not continuous and bounded, or the critics cannot read
            its observations.
    """

    columns = ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy")
    model: SACLoss

    def networks(self, env: EnvBase) -> nn.Module:
        """Builds the loss with policy, critics, their targets and the temperature."""
        recipe, spec = self.recipe, env.action_spec_unbatched
        check_actions(
            recipe, spec, has_bounds(spec), "continuous actions within bounds", "a ppo recipe"
        )
        backbone, size = self.make_backbone(env), spec.shape[0]
        head = nn.Sequential(nn.Linear(backbone.features_dim, 2 * size), NormalParamExtractor())
        self._policy = ProbabilisticActor(
            TensorDictSequential(backbone, TensorModule(head, ["features"], ["loc", "scale"])),
            in_keys=["loc", "scale"],
            distribution_class=TanhNormal,
            distribution_kwargs={"low": spec.space.low, "high": spec.space.high},
        ).to(self.device)
        # Two critics keep their initial weights; TorchRL would copy a single one and re-initialize
        # the copy.
        loss = SACLoss(
            self._policy,
            [self.make_critic(env, spec) for _ in range(2)],
            loss_function="l2",
            target_entropy=target_entropy(spec),
            deactivate_vmap=recipe.backbone.carries_state,  # it cannot map over an LSTM
        )
        loss.make_value_estimator(gamma=recipe.gamma)
        return loss

    def prepare(self, step: int, folder: Path) -> None:
        """As :meth:`ReplayAlgorithm.prepare`, with the update of the targets."""
        self.target = SoftUpdate(self.model, tau=self.recipe.tau)
        super().prepare(step, folder)

    def loss(self, samples: TensorDictBase) -> TensorDictBase:
        """Returns the terms of the loss; see :meth:`ReplayAlgorithm.loss`."""
        return self.model(samples)

    def learn(self, samples: TensorDictBase, number: int) -> Terms:
        """Takes a gradient step on all networks, and moves the targets."""
        terms = self.loss(samples)
        descend(terms, self.optimizer)
        self.target.step()
        return terms
