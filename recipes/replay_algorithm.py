"""The base class of algorithms that collect steps and learn from samples of them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.collectors import BaseCollector, Collector
from torchrl.data import ReplayBuffer, TensorSpec
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from torchrl_tit.datasets import OnlineHistoryStorage, make_sampler
from torchrl_tit.envs import observation_specs
from torchrl_tit.evaluation import evaluate, finished_returns
from torchrl_tit.modules import ActingCollector, Backbone, while_acting

from .algorithm import Algorithm, Stateful, check_finite
from .outcomes import Outcome
from .policies import make_backbone
from .ray_collector import ClusterCollector, check_cluster
from .replay_recipe import ReplayRecipe
from .shares import make_share
from .stateful import BufferState
from .task import make_task, seed_copies

RecipeT = TypeVar("RecipeT", bound=ReplayRecipe)

_STORED = [
    "observation",
    "action",
    "action_mask",
    *(("next", name) for name in ("observation", "action_mask", "reward", "terminated", "done")),
]


class ReplayAlgorithm(Algorithm[RecipeT]):
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
        self.collector = self._make_collector(step)
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
        return while_acting(self.behaviour, self.collector)

    def size(self, batch: TensorDictBase) -> int:
        """The number of environment steps."""
        return batch.numel()

    def returns(self, batch: TensorDictBase) -> Tensor:
        """Returns of the episodes that ended in a batch."""
        return finished_returns(batch)

    def update(self, batch: TensorDictBase, step: int) -> dict[str, Tensor | float]:
        """Stores a batch, then takes gradient steps on samples from the buffer."""
        recipe = self.recipe
        self.buffer.extend(self.stored(batch))
        values = torch.full((len(self.columns),), torch.nan)
        if step + batch.numel() > recipe.random_steps:
            before = (step - recipe.random_steps) // recipe.steps_per_batch
            self.policy.train()
            for number in range(recipe.updates_per_batch):
                samples = self.buffer.sample()
                values = self._step(samples, before * recipe.updates_per_batch + number)
            self.policy.eval()
            check_finite(self.columns, values)
            if recipe.ray is not None:
                self.collector.update_policy_weights_()
        return dict(zip(self.columns, values, strict=True))

    def stored(self, batch: TensorDictBase) -> TensorDictBase:
        """Selects the entries of a batch to store."""
        return batch.select(*_STORED, strict=False)

    def play(self, step: int) -> list[Outcome]:
        """Plays full episodes, each with its own seed, with the policy's most likely action."""
        seed, episodes = self.recipe.evaluation_seed, self.recipe.evaluation_episodes
        returns = evaluate(self.make_env, self.policy, episodes, seed=seed)
        return [Outcome(step, returns.tolist())]

    def check(self) -> None:
        """As :meth:`Algorithm.check`; a cluster must have room for the collectors."""
        check_cluster(self.recipe.ray, self.recipe.collectors, self.recipe.threads)
        super().check()

    def close(self) -> None:
        """Closes the environments."""
        self.collector.shutdown()

    def _make_collector(self, step: int) -> BaseCollector:
        """Builds the collector of batches [envs, time], in this process or on Ray."""
        recipe = self.recipe
        random_steps = recipe.random_steps if self.draws_random_steps else 0
        steps: dict[str, Any] = {
            "frames_per_batch": recipe.steps_per_batch,
            "total_frames": recipe.final_step - step,
            "init_random_frames": max(0, random_steps - step),
        }
        own: dict[str, Any] = {
            "trust_policy": True,  # ours is on the right device already
            "track_traj_ids": False,
            "auto_register_policy_transforms": False,
        }
        if recipe.ray is None:
            return Collector(
                seed_copies(self.make_env(recipe.num_envs), recipe.seed, step),
                self.behaviour,
                device=self.device,
                **steps,
                **own,
            )
        there = replace(recipe, device="cpu")
        share = recipe.num_envs // recipe.collectors
        make_envs = partial(make_task, there, clip_actions=False)
        return ClusterCollector(
            [
                partial(make_share, make_envs, there, share, step, index)
                for index in range(recipe.collectors)
            ],
            self.behaviour,
            address=recipe.ray,
            threads=recipe.threads,
            device=self.device,
            collector_class=ActingCollector,
            settings=own,
            **steps,
        )

    @abstractmethod
    def _step(self, batch: TensorDictBase, number: int) -> Tensor:
        """Takes a gradient step.

        Args:
            batch: transitions [B] or slices [N, T].
            number: number of gradient steps taken before.

        Returns:
            The values of ``columns``, float [columns].
        """
