"""What algorithms share that collect steps, store them, and learn from samples of them."""

from __future__ import annotations

import math
import warnings
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase

from torchrl_tit.checkpoint import load_checkpoint, remove_checkpoint, save_checkpoint
from torchrl_tit.datasets import OnlineHistoryStorage, make_sampler
from torchrl_tit.envs import observation_specs
from torchrl_tit.frames import NormalizedFrames
from torchrl_tit.settings.choices import Device
from torchrl_tit.settings.numbers import Batch, Steps, Weight

from .core.algorithm import (
    Stateful,
    Terms,
    storage_device,
    to_networks,
)
from .core.networks import (
    LearnsFromSamples,
    arranging,
    check_normalizes,
    set_statistics,
    state_transforms,
)
from .core.recipe import SamplesRecipe
from .core.task import make_task
from .online import OnlineAlgorithm, OnlineRecipe

_STORED = [
    "observation",
    "action",
    "action_mask",
    *(("next", name) for name in ("observation", "action_mask", "reward", "terminated", "done")),
]


@dataclass(frozen=True, kw_only=True)
class ReplayRecipe(OnlineRecipe, SamplesRecipe):
    """Settings of every recipe that learns online from a replay buffer."""

    total_steps: Steps = 1_000_000
    """Environment steps to train for, rounded up to whole batches."""
    random_steps: Steps = 1000
    """Steps at the start with uniformly random actions, during which nothing is learned; must be a
    multiple of steps_per_batch."""
    steps_per_batch: Batch = 50
    """Environment steps between two rounds of gradient steps; must be a multiple of num_envs."""
    updates_per_step: Weight = 1.0
    """Gradient steps for each environment step; a whole number of them follows each batch."""
    buffer_size: Batch = 1_000_000
    """Capacity of the replay buffer in steps; when it is full, new steps replace the oldest."""
    normalize_observations: bool = False
    """Whether to normalize observations by their mean and standard deviation in the random steps
    (with ``--init-from``, also in those of the other run), and to clip them to +-10; only for
    arrays of floats. Entries that are constant in these steps have a deviation of 1."""
    storage_device: Device = "cpu"
    """Device of the stored data, from which batches are moved to the networks; the CPU if these are
    there. "cuda" is faster if all data fit on the GPU."""
    log_interval: Steps = 1000
    """Environment steps between rows of metrics."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.check_divides("steps_per_batch", "random_steps", self.random_steps)
        updates = self.steps_per_batch * self.updates_per_step
        if self.updates_per_batch < 1 or not math.isclose(updates, self.updates_per_batch):
            raise ValueError(
                f"updates_per_step {self.updates_per_step:g} times steps_per_batch "
                f"{self.steps_per_batch} is {updates:g} gradient steps: make it a whole number, at "
                "least 1"
            )
        if self.collectors > 1 and self.ray is None:
            raise ValueError(
                f"collectors is {self.collectors}, but {self.algorithm} collects in one process, "
                "or on a Ray cluster: set ray to its address, such as auto, or collectors to 1"
            )
        if self.buffer_size < max(self.steps_per_batch, self.drawn_length * self.num_envs):
            raise ValueError(
                f"buffer_size {self.buffer_size} has no room for a batch of {self.steps_per_batch} "
                "steps and a slice of each environment: make it larger"
            )
        if self.drawn_length * self.num_envs > self.random_steps:
            burn_in = f" and burn_in {self.burn_in} are" if self.burn_in else " is"
            raise ValueError(
                f"slice_length {self.slice_length}{burn_in} longer than the {self.random_steps} "
                f"random_steps of {self.num_envs} environments: change one of them"
            )

    @property
    def updates_per_batch(self) -> int:
        """Gradient steps after each batch."""
        return round(self.steps_per_batch * self.updates_per_step)


RecipeT = TypeVar("RecipeT", bound=ReplayRecipe)


class ReplayAlgorithm(LearnsFromSamples, OnlineAlgorithm[RecipeT]):
    """An algorithm with a replay buffer, whose model is a TorchRL loss on all its networks.

    Args:
        recipe: the settings.
    """

    draws_random_steps: ClassVar[bool] = True
    """Whether the collector, not :attr:`behavior`, draws the actions of the random steps at the
    start."""

    optimizer: torch.optim.Optimizer
    """The optimizer, once :meth:`prepare` has made it."""

    def __init__(self, recipe: RecipeT) -> None:
        super().__init__(recipe)
        with closing(make_task(recipe, clip_actions=False)) as task:
            if recipe.normalize_observations:
                check_normalizes(recipe.env, observation_specs(task))
            self.model = self.networks(task).to(self.device)

    @property
    def behavior(self) -> TensorDictModuleBase:
        """The policy that the collector runs; by default, :attr:`policy`."""
        return self._policy

    def make_env(self, num_envs: int, seed: int | None = None, **settings: Any) -> EnvBase:
        """As :meth:`OnlineAlgorithm.make_env`; actions are passed on unchanged."""
        return super().make_env(num_envs, seed, clip_actions=False, **settings)

    def check(self) -> None:
        """As :meth:`OnlineAlgorithm.check`; warns if the run ends before anything is learned."""
        recipe = self.recipe
        if recipe.final_step <= recipe.random_steps:
            warnings.warn(
                f"total_steps {recipe.total_steps} end within the {recipe.random_steps} "
                "random_steps, so nothing will be learned: raise total_steps",
                stacklevel=2,
            )
        super().check()

    def prepare(self, step: int, folder: Path) -> None:
        """Builds optimizer, collector and replay buffer."""
        recipe: Any = self.recipe
        rate = recipe.learning_rate
        self.optimizer = torch.optim.Adam(self.model.parameters(), lr=rate, fused=True)
        self.policy.eval()
        random_steps = recipe.random_steps if self.draws_random_steps else 0
        self.collector = self.make_collector(
            self.behavior,
            partial(make_task, state=state_transforms(self.policy), clip_actions=False),
            step,
            random_steps=max(0, random_steps - step),
        )
        storage = OnlineHistoryStorage(
            recipe.buffer_size,
            recipe.backbone.num_frames,
            ndim=2,
            padding=recipe.padding,
            is_init=recipe.slice_length > 1,
            device=storage_device(recipe),
        )
        self.buffer = ReplayBuffer(
            storage=storage,
            sampler=make_sampler(recipe.drawn_length),
            batch_size=recipe.drawn_size,
            transform=arranging(recipe),
        )
        self.buffer_state = BufferState(self.buffer, folder / "replay")

    def state(self) -> Mapping[str, Stateful]:
        """Optimizer and replay buffer."""
        return {"optimizer": self.optimizer, "buffer": self.buffer_state}

    def batches(self) -> Iterator[TensorDictBase]:
        """Yields collected batches, [envs, time]; the environments begin new episodes."""
        self.buffer_state.storage.end_episodes()
        for batch in self.collector:
            yield batch
            if not self.collects_here:  # after random steps, too: they may change statistics
                self.collector.update_policy_weights_()

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor | float]:
        """Stores a batch, then takes gradient steps; returns the means of their terms."""
        recipe, count = self.recipe, batch.numel()
        if recipe.normalize_observations and step < recipe.random_steps:
            seen = batch["observation"].flatten(0, 1).to(self.device)

            def add(frames: NormalizedFrames) -> None:
                frames.update(seen)
                if step + count >= recipe.random_steps:
                    frames.fix_constant()

            set_statistics(self.policy, self.model, add)
        self.buffer.extend(self.collected(batch).select(*_STORED, strict=False))
        if step + count <= recipe.random_steps:
            return {}
        done = (step - recipe.random_steps) // recipe.steps_per_batch * recipe.updates_per_batch
        self.policy.train()
        taken = [
            self.numbers(self.learn(to_networks(self.buffer.sample(), self.device), number))
            for number in range(done, done + recipe.updates_per_batch)
        ]
        self.policy.eval()
        return {name: torch.stack([t[name] for t in taken]).nanmean() for name in self.columns}

    @abstractmethod
    def learn(self, samples: TensorDictBase, number: int) -> Terms:
        """Takes a gradient step on :meth:`loss`, and updates the targets.

        Args:
            samples: transitions [B], or slices of consecutive ones, [N, T]; for a network that
                carries a state, with what :func:`~torchrl_tit.modules.as_sequences` adds.
            number: number of gradient steps taken before.

        Returns:
            A number for each of ``columns``, float [], among others.
        """


class BufferState:
    """The state of a replay buffer, as parts on the disk.

    Each checkpoint writes the steps since the one before, each frame once, and lists the parts that
    belong to it. A checkpoint that held all steps itself would be as large as the buffer. Parts
    whose steps were overwritten are removed, once no checkpoint that is kept needs them.

    Args:
        buffer: a buffer with an :class:`~torchrl_tit.datasets.OnlineHistoryStorage` and TorchRL's
            default writer. Its sampler has no state of its own.
        folder: folder of the parts, each numbered by the total number of steps at its end.
        checkpoints: how many checkpoints are kept.
    """

    def __init__(self, buffer: ReplayBuffer, folder: Path, checkpoints: int = 3) -> None:
        self.buffer = buffer
        self.storage: OnlineHistoryStorage = buffer.storage
        self.folder = folder
        self.checkpoints = checkpoints
        self._parts: list[int] = []  # on the disk

    def state_dict(self) -> dict[str, Any]:
        """Writes the new steps, and returns the numbers of the parts."""
        before, count = max(self._parts, default=0), self.storage.num_written
        if count > before:
            save_checkpoint(self.folder, count, self.storage.part(before), keep=count)
            self._parts.append(count)
            # The checkpoint of this part is not there yet; the ones before it are.
            kept = self._needed(self._parts[-self.checkpoints - 1 :][0])
            for number in set(self._parts) - set(kept):
                remove_checkpoint(self.folder, number)
            self._parts = kept
        needed = self._needed(count)
        return {
            "parts": needed,
            "older_parts": [number for number in self._parts if number not in needed],
            "writer": self.buffer.writer.state_dict(),
        }

    def load_state_dict(self, state_dict: dict[str, Any], /) -> None:
        """Reads a checkpoint's parts. Other parts belong to lost work and will be replaced."""
        self._parts = [*state_dict["older_parts"], *state_dict["parts"]]
        for number in state_dict["parts"]:
            self.storage.add_part(load_checkpoint(self.folder, number)[1])
        self.buffer.writer.load_state_dict(state_dict["writer"])

    def _needed(self, count: int) -> list[int]:
        """The parts that the buffer's items need once ``count`` steps are written."""
        return [number for number in self._parts if number > count - self.storage.reach]
