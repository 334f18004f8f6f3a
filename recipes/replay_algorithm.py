"""The base class of algorithms that collect steps and learn from samples of them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer, TensorSpec
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from torchrl_tit.datasets import OnlineHistoryStorage, make_sampler
from torchrl_tit.envs import observation_specs
from torchrl_tit.modules import Backbone

from .algorithm import Stateful, check_finite
from .online import OnlineAlgorithm, OnlineRecipe
from .policies import make_backbone
from .replay_recipe import ReplayRecipe
from .stateful import BufferState
from .task import make_task

RecipeT = TypeVar("RecipeT", bound=ReplayRecipe)

_STORED = [
    "observation",
    "action",
    "action_mask",
    *(("next", name) for name in ("observation", "action_mask", "reward", "terminated", "done")),
]


class ReplayAlgorithm(OnlineAlgorithm[RecipeT]):
    """An algorithm with TorchRL's collector and a replay buffer, whose loss holds all weights.

    Args:
        recipe: the settings.
    """

    draws_random_steps: ClassVar[bool] = True
    """Whether the collector, not :attr:`behaviour`, draws the actions of the random steps at the
    start."""

    loss: LossModule
    """The losses, with all weights."""
    optimizer: torch.optim.Optimizer
    """The optimizer, once :meth:`prepare` has made it."""
    _policy: TensorDictModuleBase

    def __init__(self, recipe: RecipeT) -> None:
        super().__init__(recipe)
        task = self.make_env(1)
        self.action_spec: TensorSpec = task.action_spec_unbatched.to(self.device)
        self.observation = observation_specs(task)
        task.close()

    @property
    def policy(self) -> TensorDictModuleBase:
        """The policy, from histories to actions; its weights are among those of the loss."""
        return self._policy

    @property
    def behaviour(self) -> TensorDictModuleBase:
        """The policy that the collector runs; by default, :attr:`policy`."""
        return self._policy

    @property
    def model(self) -> nn.Module:  # type: ignore[override]
        """All networks and their targets."""
        return self.loss

    def make_env(self, num_envs: int, seed: int | None = None, **settings: Any) -> EnvBase:
        """Builds the task, with histories; actions are passed on unchanged."""
        return make_task(self.recipe, num_envs, seed, clip_actions=False, **settings)

    def make_backbone(self, *, slices: bool = False) -> Backbone:
        """Builds the policy's backbone; see :func:`~recipes.policies.make_backbone`."""
        return make_backbone(self.recipe.backbone, self.observation, slices=slices)

    def prepare(self, step: int, folder: Path) -> None:
        """Builds collector and replay buffer."""
        recipe = self.recipe
        self.policy.eval()
        random_steps = recipe.random_steps if self.draws_random_steps else 0
        self.collector = self.make_collector(
            self.behaviour, _make_envs, step, random_steps=max(0, random_steps - step)
        )
        storage = OnlineHistoryStorage(
            recipe.buffer_size,
            recipe.backbone.num_frames,
            ndim=2,
            padding=recipe.padding,
            is_init=recipe.slice_length > 1,
            device=self.device,
        )
        self.buffer = ReplayBuffer(
            storage=storage,
            sampler=make_sampler(recipe.slice_length),
            batch_size=recipe.batch_size,
        )
        self.buffer_state = BufferState(self.buffer, folder / "replay")

    def state(self) -> Mapping[str, Stateful]:
        """Optimizer and replay buffer."""
        return {
            "optimizer": self.optimizer,
            "buffer": self.buffer_state,
        }

    def batches(self) -> Iterator[TensorDictBase]:
        """Yields collected batches, [envs, time]; the environments begin new episodes."""
        self.buffer_state.storage.end_episodes()
        return iter(self.collector)

    def update(self, batch: TensorDictBase, step: int) -> dict[str, Tensor | float]:
        """Stores a batch, then takes gradient steps on samples from the buffer."""
        recipe = self.recipe
        self.buffer.extend(self.stored(self.collected(batch)))
        values = torch.full((len(self.columns),), torch.nan)
        if step + batch.numel() > recipe.random_steps:
            before = (step - recipe.random_steps) // recipe.steps_per_batch
            self.policy.train()
            for number in range(recipe.updates_per_batch):
                samples = self.buffer.sample()
                values = self._step(samples, before * recipe.updates_per_batch + number)
            self.policy.eval()
            check_finite(self.columns, values)
            if not self.collects_here:
                self.collector.update_policy_weights_()
        return dict(zip(self.columns, values, strict=True))

    def stored(self, batch: TensorDictBase) -> TensorDictBase:
        """Selects the entries of a batch to store."""
        return batch.select(*_STORED, strict=False)

    @abstractmethod
    def _step(self, batch: TensorDictBase, number: int) -> Tensor:
        """Takes a gradient step.

        Args:
            batch: transitions [B] or slices [N, T].
            number: number of gradient steps taken before.

        Returns:
            The values of ``columns``, float [columns].
        """


def _make_envs(recipe: OnlineRecipe, num_envs: int) -> EnvBase:
    """Builds the environments in which steps are collected."""
    return make_task(recipe, num_envs, clip_actions=False)
