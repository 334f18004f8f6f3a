"""DQN: act greedily or at random, store transitions, and learn values from samples of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.modules import EGreedyModule
from torchrl.objectives import DQNLoss, HardUpdate, SoftUpdate, TargetNetUpdater

from ..algorithm import Stateful
from ..policies import describe, is_discrete, make_value_policy
from ..replay_algorithm import ReplayAlgorithm
from .settings import DQN


class DQNAlgorithm(ReplayAlgorithm[DQN]):
    """TorchRL's DQN loss and exploration, with a value for each action on a backbone.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task's actions are not a few discrete ones.
    """

    draws_random_steps = False  # epsilon is 1 until then, and there may be masks
    columns = ("loss", "epsilon")
    optional_columns = columns  # nothing is learned during the random steps

    target: TargetNetUpdater

    def __init__(self, recipe: DQN) -> None:
        super().__init__(recipe)
        spec = self.action_spec
        if not is_discrete(spec):
            raise ValueError(
                f"dqn needs a few discrete actions, but those of {recipe.env} are "
                f"{describe(spec)}: use a {'sac or ' if spec.dtype.is_floating_point else ''}ppo "
                "recipe"
            )
        backbone = self.make_backbone(slices=recipe.slice_length > 1)
        mask_key = "action_mask" if recipe.mask_actions else None
        self._policy = make_value_policy(backbone, spec, mask_key=mask_key).to(self.device)
        self.exploration = EGreedyModule(
            spec,
            eps_end=recipe.final_epsilon,
            annealing_num_steps=recipe.exploration_steps,
            action_mask_key=mask_key,
            device=self.device,
        )
        self._behaviour = TensorDictSequential(self._policy, self.exploration)
        self.loss = DQNLoss(
            self._policy,
            loss_function=recipe.loss_function,
            double_dqn=recipe.double,
            action_space="categorical",
        )
        self.loss.make_value_estimator(gamma=recipe.gamma)

    @property
    def behaviour(self) -> TensorDictModuleBase:
        """The policy, with random actions whose probability falls."""
        return self._behaviour

    def prepare(self, step: int, folder: Path) -> None:
        """Builds optimizer, target update, collector and replay buffer."""
        recipe = self.recipe
        self.optimizer = torch.optim.Adam(
            self.loss.parameters(), lr=recipe.learning_rate, fused=True
        )
        if recipe.tau < 1:
            self.target = SoftUpdate(self.loss, tau=recipe.tau)
        else:  # copies at each of its steps
            self.target = HardUpdate(self.loss, value_network_update_interval=0)
        super().prepare(step, folder)

    def state(self) -> Mapping[str, Stateful]:
        """As :meth:`ReplayAlgorithm.state`, and the probability of random actions."""
        return {**super().state(), "exploration": self.exploration}

    def update(self, batch: TensorDictBase, step: int) -> dict[str, Tensor | float]:
        """As :meth:`ReplayAlgorithm.update`; random actions then become less likely."""
        terms = super().update(batch, step)
        if step + batch.numel() > self.recipe.random_steps:
            self.exploration.step(batch.numel())
        return terms

    def stored(self, batch: TensorDictBase) -> TensorDictBase:
        """Selects the entries of a batch to store, with clipped rewards if requested."""
        stored = super().stored(batch)
        if self.recipe.clip_rewards:
            stored["next", "reward"] = stored["next", "reward"].sign()
        return stored

    def _step(self, batch: TensorDictBase, number: int) -> Tensor:
        loss = self.loss(batch)["loss"]
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        if (number + 1) % self.recipe.target_interval == 0:
            self.target.step()
        return torch.stack([loss.detach(), self.exploration.eps])
