"""The base class of algorithms that learn from transitions of a data set."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer, TensorSpec
from torchrl.envs import EnvBase, ObservationNorm
from torchrl.objectives import LossModule

from torchrl_tit.datasets import Episodes, HistoryStorage, load_episodes, make_replay_buffer
from torchrl_tit.envs import observation_specs
from torchrl_tit.evaluation import evaluate
from torchrl_tit.modules import Backbone

from .algorithm import check_finite
from .dataset_algorithm import DatasetAlgorithm
from .outcomes import Outcome
from .policies import make_backbone
from .task import make_task
from .transition_recipe import TransitionRecipe

RecipeT = TypeVar("RecipeT", bound=TransitionRecipe)


class TransitionAlgorithm(DatasetAlgorithm[RecipeT]):
    """An algorithm whose loss holds the weights of all networks, including the policy's.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task has several observations, or observations that are to be normalised
            are not floats.
    """

    clips_actions: ClassVar[bool] = False
    """Whether the task clips actions, because the policy may exceed the bounds."""

    loss: LossModule
    """The losses, with all weights."""
    _policy: TensorDictModuleBase

    def __init__(self, recipe: RecipeT) -> None:
        super().__init__(recipe)
        task = self._make_task(1)
        self.action_spec = task.action_spec_unbatched.to(self.device)
        observation = observation_specs(task)
        task.close()
        if isinstance(observation, dict):
            raise ValueError(
                f"data sets hold one observation, but {recipe.env} has several "
                f"({', '.join(observation)}): choose one with observation_keys"
            )
        self.observation: TensorSpec = observation
        self.statistics = nn.Module()
        """The statistics that normalise observations, filled in from the data."""
        if recipe.normalize_observations:
            if not observation.dtype.is_floating_point:
                raise ValueError(
                    f"normalize_observations is on, but observations of {recipe.env} are "
                    f"{observation.dtype}, not floats: switch it off"
                )
            mean = torch.zeros(observation.shape, device=self.device)
            self.statistics.register_buffer("mean", mean)
            self.statistics.register_buffer("std", torch.ones_like(mean))

    @property
    def continuous(self) -> bool:
        """Whether the task's actions are floats."""
        return self.action_spec.dtype.is_floating_point

    @property
    def policy(self) -> TensorDictModuleBase:
        """The policy, from histories to actions; its weights are among those of the loss."""
        return self._policy

    def networks(self) -> nn.Module:
        """All networks and their targets, and the statistics of normalised observations."""
        if not self.recipe.normalize_observations:
            return self.loss
        return nn.ModuleDict({"loss": self.loss, "statistics": self.statistics})

    def acting_networks(self) -> nn.Module:
        """The policy, and the statistics of normalised observations."""
        if not self.recipe.normalize_observations:
            return self.policy
        return nn.ModuleDict({"policy": self.policy, "statistics": self.statistics})

    def make_env(self, num_envs: int, seed: int | None = None, **settings: Any) -> EnvBase:
        """Builds the task, with histories, and with normalised observations if requested."""
        env = self._make_task(num_envs, seed, **settings)
        if self.recipe.normalize_observations:
            env = env.append_transform(self._normalization("observation", "history"))
        return env

    def make_backbone(self, *, slices: bool = False) -> Backbone:
        """Builds the policy's backbone.

        Args:
            slices: as in :func:`~recipes.policies.make_backbone`; always on if the recipe draws
                slices.
        """
        slices = slices or self.recipe.slice_length > 1
        return make_backbone(self.recipe.backbone, self.observation, slices=slices)

    def load_data(self) -> Episodes:
        """Loads the data set.

        Raises:
            ValueError: if its actions are of another kind than those of the task.
            FileNotFoundError: if there are no such data.
        """
        recipe = self.recipe
        episodes = load_episodes(recipe.dataset, **recipe.reading())
        if episodes.rows["action"].is_floating_point() != self.continuous:
            found, expected = ("integers", "floats") if self.continuous else ("floats", "integers")
            raise ValueError(
                f"the actions in {recipe.dataset} are {found}, but those of {recipe.env} are "
                f"{expected}: use other data"
            )
        return episodes

    def make_buffer(self) -> ReplayBuffer:
        """Reads the data set into a replay buffer of transitions with histories."""
        recipe = self.recipe
        episodes = self.load_data()
        settings: dict[str, Any] = {}
        if recipe.normalize_observations:
            mean, std = episodes.observation_statistics()
            self.statistics.load_state_dict({"mean": mean, "std": std})
            keys = ("observation", "history")
            settings["transform"] = self._normalization(*keys, *(("next", key) for key in keys))
        storage = HistoryStorage(
            episodes.to(self.device), recipe.backbone.num_frames, **recipe.drawing()
        )
        return make_replay_buffer(
            storage,
            recipe.batch_size,
            seed=recipe.seed,
            slice_length=recipe.slice_length,
            **settings,
        )

    def named(self, terms: Tensor) -> Mapping[str, Tensor]:
        """Checks and names the terms of an update, float [columns].

        On a GPU, checking would have to wait for it, so the runner checks there instead, less
        often.
        """
        if terms.device.type == "cpu":
            check_finite(self.columns, terms)
        return dict(zip(self.columns, terms, strict=True))

    def play(self, step: int) -> list[Outcome]:
        """Plays full episodes side by side, each with its own seed, without dropout."""
        seed, episodes = self.recipe.evaluation_seed, self.recipe.evaluation_episodes
        returns = evaluate(self.make_env, self.policy, episodes, seed=seed, shrink=True)
        return [Outcome(step, returns.tolist())]

    def _make_task(self, num_envs: int, seed: int | None = None, **settings: Any) -> EnvBase:
        clips = self.clips_actions
        return make_task(self.recipe, num_envs, seed, clip_actions=clips, **settings)

    def _normalization(self, *keys: Any) -> ObservationNorm:
        """Subtracts the data's mean from entries, and divides by the data's standard deviation."""
        mean, std = self.statistics.buffers()
        return ObservationNorm(mean, std, in_keys=list(keys), standard_normal=True)


def parameters_of(params: Any) -> list[nn.Parameter]:
    """Lists the parameters of one of a loss's networks, for an optimizer."""
    return [p for p in params.values(True, True) if isinstance(p, nn.Parameter)]


def descend(loss: Tensor, *optimizers: torch.optim.Optimizer) -> None:
    """Takes a gradient descent step on a loss."""
    for optimizer in optimizers:
        optimizer.zero_grad()
    loss.backward()
    for optimizer in optimizers:
        optimizer.step()
