"""What all algorithms share that learn from steps they collect."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import BaseCollector, MultiSyncCollector
from torchrl.envs import EnvBase

from torchrl_tit.evaluation import finished_returns
from torchrl_tit.modules import ActingCollector
from torchrl_tit.settings.choices import Padding
from torchrl_tit.settings.numbers import Batch, Copies, Fraction, Steps

from .core.algorithm import Algorithm
from .core.networks import state_transforms
from .core.ray_cluster import ask_for_machines, check_room
from .core.recipe import Recipe
from .core.task import make_task, seed_copies


@dataclass(frozen=True, kw_only=True)
class OnlineRecipe(Recipe):
    """Settings of every recipe that learns from steps it collects."""

    padding: Padding = "same"
    """What fills a history before the first observation: that observation, or zeros."""
    hide_velocities: bool = False
    """Whether to remove velocities from observations, so that one observation is not enough."""
    num_envs: Copies = 1
    """Number of environments; they share the steps of a batch."""
    total_steps: Steps = 100_000
    """Environment steps to train for, rounded up to whole batches."""
    steps_per_batch: Batch = 2048
    """Environment steps collected before each update; must be a multiple of num_envs."""
    gamma: Fraction = 0.99
    """Discount factor."""
    collectors: Copies = 1
    """Number of processes that collect, each with its share of the environments; 1 collects in the
    training process, unless ray is set. Use several for slow environments."""
    ray: str | None = None
    """Address of a Ray cluster whose machines the collectors run on: auto, or HOST:PORT. See
    docs/recipes.md."""
    evaluation_interval: Steps | None = None
    """Environment steps between evaluations during training, whose mean return is the column
    evaluation_return of the metrics. Without it, only the final weights are evaluated."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_divides("num_envs", "steps_per_batch", self.steps_per_batch)
        self.check_divides("collectors", "num_envs", self.num_envs)
        if self.ray == "":
            raise ValueError("ray is empty: it is the address of a Ray cluster, such as auto")
        if self.ray is not None and self.ray.startswith("ray://"):
            raise ValueError(
                f"ray is {self.ray!r}, an address for programs outside the cluster, but collectors "
                "get their weights straight from the training process: start it on a machine of "
                "the cluster, with auto or HOST:PORT"
            )

    @property
    def final_step(self) -> int:
        """``total_steps``, rounded up to whole batches."""
        return math.ceil(self.total_steps / self.steps_per_batch) * self.steps_per_batch

    @property
    def target_columns(self) -> dict[float | None, str]:
        """The column of evaluations; online, there are no target returns."""
        return {} if self.evaluation_interval is None else {None: "evaluation_return"}

    def evaluation_due(self, before: int, step: int) -> bool:
        """See :meth:`Recipe.evaluation_due`."""
        interval = self.evaluation_interval
        return interval is not None and step // interval > before // interval


RecipeT = TypeVar("RecipeT", bound=OnlineRecipe)


class OnlineAlgorithm(Algorithm[RecipeT]):
    """An algorithm whose batches are steps that its policy collects, [envs, time].

    Args:
        recipe: the settings.
    """

    collector: BaseCollector
    """TorchRL's collector, once :meth:`prepare` has built it."""

    def collected(self, batch: TensorDictBase) -> TensorDictBase:
        """Receives each collected batch, [envs, time], before anything is learned from it.

        Override it to change what is learned from, such as the rewards, for an exploration bonus.
        Reported returns are those of the task.

        Returns:
            The batch.
        """
        return batch

    def make_env(self, num_envs: int, seed: int | None = None, **settings: Any) -> EnvBase:
        """Builds the task, with histories, and with the state of a recurrent network."""
        return make_task(
            self.recipe, num_envs, seed, state=state_transforms(self.policy), **settings
        )

    def size(self, batch: TensorDictBase) -> int:
        """The number of environment steps."""
        return batch.numel()

    def returns(self, batch: TensorDictBase) -> Tensor:
        """Returns of the episodes that ended in a batch."""
        return finished_returns(batch)

    def check(self) -> None:
        """As :meth:`Algorithm.check`; a cluster must have room for the collectors."""
        if (address := self.recipe.ray) is not None:
            check_room(
                ask_for_machines(address), address, self.recipe.collectors, self.recipe.threads
            )
        super().check()

    def close(self) -> None:
        """Closes environments and processes."""
        self.collector.shutdown()

    @property
    def collects_here(self) -> bool:
        """Whether the training process collects, and not others with copies of the policy."""
        return self.recipe.collectors == 1 and self.recipe.ray is None

    def make_collector(
        self,
        policy: TensorDictModuleBase,
        make_envs: Callable[[OnlineRecipe, int], EnvBase],
        step: int,
        collector_class: type[ActingCollector] = ActingCollector,
        random_steps: int = 0,
        **settings: Any,
    ) -> BaseCollector:
        """Builds the collector of batches: in this process, in several, or on a Ray cluster.

        Several processes share the environments, each with a copy of the policy. Environments begin
        new episodes, also if the run is resumed.

        Args:
            policy: the policy, from histories to actions.
            make_envs: builds a number of environments for a recipe; called in each process.
            step: number of steps already done.
            collector_class: the collector in each process.
            random_steps: number of steps at the start with uniformly random actions.
            **settings: further arguments of that collector.
        """
        recipe = self.recipe
        length = {
            "frames_per_batch": recipe.steps_per_batch,
            "total_frames": recipe.final_step - step,
            "init_random_frames": random_steps,
        }
        settings |= {
            "trust_policy": True,  # ours is on the right device already
            "auto_register_policy_transforms": False,
        }
        if self.collects_here:
            envs = seed_copies(make_envs(recipe, recipe.num_envs), recipe.seed, step)
            settings |= {"track_traj_ids": False, "device": self.device}
            return collector_class(envs, policy, **length, **settings)
        there = recipe if recipe.ray is None else replace(recipe, device="cpu")
        share = partial(_make_share, make_envs, there, step)
        shares = [partial(share, index) for index in range(recipe.collectors)]
        if recipe.ray is None:
            return MultiSyncCollector(
                shares,
                policy,
                collector_class=collector_class,
                device=self.device,
                **length,
                **settings,
            )
        from .core.ray_collector import ClusterCollector  # Ray is an extra

        return ClusterCollector(
            shares,
            policy,
            address=recipe.ray,
            threads=recipe.threads,
            device=self.device,
            collector_class=collector_class,
            settings=settings,
            **length,
        )


def _make_share(
    make_envs: Callable[[OnlineRecipe, int], EnvBase], recipe: OnlineRecipe, step: int, index: int
) -> EnvBase:
    """Builds the environments of one of several collectors, in that collector's process.

    Random numbers depend on the run's seed and on the step at which the process starts. The
    environments have the same seeds as in one process.
    """
    if recipe.ray is None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the training process
    torch.set_num_threads(recipe.threads)
    seeds = np.random.SeedSequence([recipe.seed, index, step])
    torch.manual_seed(seeds.generate_state(1).item())
    count = recipe.num_envs // recipe.collectors
    envs = make_envs(recipe, count)
    return seed_copies(envs, recipe.seed, step, first=index * count)
