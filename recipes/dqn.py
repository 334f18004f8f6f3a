"""DQN with any network: act greedily or at random, store the steps, and learn values from them.

Settings first, then the algorithm. To change it, subclass both and override one of ``networks``,
``collected`` and ``loss``: docs/how-to/change-sac-dqn-cql.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import EGreedyModule
from torchrl.objectives import DQNLoss, HardUpdate, SoftUpdate, TargetNetUpdater

from torchrl_tit.envs.action_masks import MASK
from torchrl_tit.settings.numbers import Batch, Fraction, Rate, Steps, Weight

from .core.algorithm import Terms, descend
from .core.networks import check_actions, is_discrete, make_value_policy
from .replay import ReplayAlgorithm, ReplayRecipe


@dataclass(frozen=True, kw_only=True)
class DQN(ReplayRecipe, algorithm="dqn"):
    """Deep Q-networks (Mnih et al., Nature 518, 2015), with double Q-learning (arXiv 1509.06461).

    The defaults are those of CleanRL for classic control.
    """

    total_steps: Steps = 500_000
    """Environment steps to train for, rounded up to whole batches."""
    random_steps: Steps = 10_000
    """Steps at the start with uniformly random actions, during which nothing is learned; must be a
    multiple of steps_per_batch."""
    steps_per_batch: Batch = 10
    """Environment steps between two rounds of gradient steps; must be a multiple of num_envs."""
    updates_per_step: Weight = 0.1
    """Gradient steps for each environment step; a whole number of them follows each batch."""
    buffer_size: Batch = 10_000
    """Capacity of the replay buffer in steps; when it is full, new steps replace the oldest."""
    batch_size: Batch = 128
    """Transitions in one gradient step, sampled with replacement."""
    learning_rate: Rate = 2.5e-4
    """Learning rate of Adam."""
    double: bool = True
    """Whether the trained network chooses the next action and the target network evaluates it
    (double Q-learning); otherwise the target network does both."""
    loss_function: Literal["l2", "smooth_l1"] = "l2"
    """Loss on the temporal difference error: its square, or the Huber loss, whose gradient is
    clipped as in the Nature paper."""
    final_epsilon: Fraction = 0.05
    """Probability of a random action at the end of exploration; at the start it is 1."""
    exploration_fraction: Fraction = 0.5
    """Fraction of all steps over which that probability falls linearly, after the random steps."""
    target_interval: Steps = 50
    """Gradient steps between updates of the target network."""
    tau: Fraction = 1.0
    """Coefficient of the soft update of the target network; 1 copies the network."""
    mask_actions: bool = False
    """Whether to mask actions that the task does not allow; see docs/environments.md."""
    clip_rewards: bool = False
    """Whether the network learns from the signs of rewards, as is usual for Atari."""

    def build(self) -> DQNAlgorithm:
        """Builds the algorithm."""
        return DQNAlgorithm(self)

    @property
    def schedules(self) -> tuple[str, ...]:
        """Exploration, which takes a fraction of the run."""
        return ("exploration_fraction",) if self.exploration_fraction else ()

    @property
    def exploration_steps(self) -> int:
        """Environment steps from the first to the last value of epsilon, at least 1."""
        return max(1, round(self.exploration_fraction * self.final_step))


class DQNAlgorithm(ReplayAlgorithm[DQN]):
    """TorchRL's DQN loss and exploration, with a value for each action on a backbone.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task's actions are not a few discrete ones.
    """

    draws_random_steps = False  # epsilon is 1 until then, and there may be masks
    columns = ("loss", "epsilon")

    target: TargetNetUpdater

    def networks(self, env: EnvBase) -> nn.Module:
        """Builds the loss with the network of the values, which is also the policy, and its target.

        Actions are random with a probability that falls: see :attr:`behavior`.
        """
        recipe, spec = self.recipe, env.action_spec_unbatched.to(self.device)
        instead = f"a {'sac or ' if spec.dtype.is_floating_point else ''}ppo recipe"
        check_actions(recipe, spec, is_discrete(spec), "a few discrete actions", instead)
        mask_key = MASK if recipe.mask_actions else None
        policy = make_value_policy(self.make_backbone(env), spec, mask_key=mask_key)
        self._policy = policy.to(self.device)
        self.exploration = EGreedyModule(spec, action_mask_key=mask_key, device=self.device)
        self._behavior = TensorDictSequential(self._policy, self.exploration)
        loss = DQNLoss(
            self._policy,
            loss_function=recipe.loss_function,
            double_dqn=recipe.double,
            action_space="categorical",
        )
        loss.make_value_estimator(gamma=recipe.gamma)
        return loss

    @property
    def behavior(self) -> TensorDictModuleBase:
        """The policy, with random actions whose probability falls."""
        return self._behavior

    def prepare(self, step: int, folder: Path) -> None:
        """As :meth:`ReplayAlgorithm.prepare`, with the update of the target."""
        if self.recipe.tau < 1:
            self.target = SoftUpdate(self.model, tau=self.recipe.tau)
        else:  # copies at each of its steps
            self.target = HardUpdate(self.model, value_network_update_interval=0)
        self._set_epsilon(step)
        super().prepare(step, folder)

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor | float]:
        """As :meth:`ReplayAlgorithm.update`; random actions then become less likely."""
        terms = super().update(batch, step)
        self._set_epsilon(step + batch.numel())
        return terms

    def collected(self, batch: TensorDictBase) -> TensorDictBase:
        """Receives each collected batch, and returns it with the rewards to train on.

        Here they are clipped, if the recipe says so.
        """
        if not self.recipe.clip_rewards:
            return batch
        return batch.copy().set(("next", "reward"), batch["next", "reward"].sign())

    def loss(self, samples: TensorDictBase) -> Terms:
        """Returns the terms of the loss; see :meth:`ReplayAlgorithm.loss`."""
        if self.recipe.mask_actions:  # a truncated state is valued, also if it allows nothing
            allowed = samples["next", MASK]
            allowed |= ~allowed.any(-1, keepdim=True)
        return {"loss_value": self.model(samples)["loss"]}

    def learn(self, samples: TensorDictBase, number: int) -> Terms:
        """Takes a gradient step on the values, and every so many copies them to the target."""
        terms = self.loss(samples)
        total = descend(terms, self.optimizer)
        if (number + 1) % self.recipe.target_interval == 0:
            self.target.step()
        return {**terms, "loss": total, "epsilon": self.exploration.eps}

    def _set_epsilon(self, step: int) -> None:
        """Sets the probability of random actions in the batch that begins at a step.

        TorchRL's module would subtract a little at each step, which float32 rounds: over 32 million
        steps, to nothing.
        """
        recipe = self.recipe
        done = min(1, max(0, step - recipe.random_steps) / recipe.exploration_steps)
        self.exploration.eps.fill_(1 - done * (1 - recipe.final_epsilon))
