"""The base class of algorithms that learn from transitions of a data set."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer, TensorSpec
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from torchrl_tit.datasets import Episodes, HistoryStorage, load_episodes, make_replay_buffer
from torchrl_tit.envs import observation_specs
from torchrl_tit.evaluation import evaluate
from torchrl_tit.frames import NormalizedFrames
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
        task = make_task(recipe, 1, clip_actions=False)  # whose spec has the bounds
        self.action_spec = task.action_spec_unbatched.to(self.device)
        observation = observation_specs(task)
        task.close()
        if isinstance(observation, dict):
            raise ValueError(
                f"data sets hold one observation, but {recipe.env} has several "
                f"({', '.join(observation)}): choose one with observation_keys"
            )
        self.observation: TensorSpec = observation
        if recipe.normalize_observations and not observation.dtype.is_floating_point:
            raise ValueError(
                f"normalize_observations is on, but observations of {recipe.env} are "
                f"{observation.dtype}, not floats: switch it off"
            )
        self.eps = 1e-3 if recipe.normalize_observations else None
        """What is added to the deviations that normalise observations, as by the authors of TD3+BC
        and by d3rlpy; None if they are not normalised."""

    @property
    def continuous(self) -> bool:
        """Whether the task's actions are floats."""
        return self.action_spec.dtype.is_floating_point

    @property
    def policy(self) -> TensorDictModuleBase:
        """The policy, from histories to actions; its weights are among those of the loss."""
        return self._policy

    @property
    def model(self) -> nn.Module:  # type: ignore[override]
        """All networks and their targets."""
        return self.loss

    def make_env(self, num_envs: int, seed: int | None = None, **settings: Any) -> EnvBase:
        """Builds the task, with histories."""
        clips = self.clips_actions
        return make_task(self.recipe, num_envs, seed, clip_actions=clips, **settings)

    def make_backbone(self, *, slices: bool = False) -> Backbone:
        """Builds the policy's backbone.

        Args:
            slices: as in :func:`~recipes.policies.make_backbone`; always on if the recipe draws
                slices.
        """
        slices = slices or self.recipe.slice_length > 1
        return make_backbone(self.recipe.backbone, self.observation, slices=slices, eps=self.eps)

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
        """Reads the data set into a replay buffer of transitions with histories.

        The networks then normalise observations by its statistics, if they do.
        """
        recipe = self.recipe
        episodes = self.load_data()
        if recipe.normalize_observations:
            self._set_statistics(*episodes.observation_statistics())
        storage = HistoryStorage(
            episodes.to(self.device), recipe.backbone.num_frames, **recipe.drawing()
        )
        return make_replay_buffer(
            storage,
            recipe.batch_size,
            seed=recipe.seed,
            slice_length=recipe.slice_length,
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

    @torch.no_grad()
    def _set_statistics(self, mean: Tensor, std: Tensor) -> None:
        """Sets the statistics of all networks: the policy's, the critics' and the targets'."""
        (frames,) = (m for m in self.policy.modules() if isinstance(m, NormalizedFrames))
        frames.set_statistics(mean, std)
        statistics = dict(frames.named_buffers(recurse=False))
        buffers = dict(self.loss.named_buffers())  # it stacks those of the critics
        for name, buffer in buffers.items():
            path, _, leaf = name.rpartition(".")
            if leaf in statistics and all(f"{path}.{own}" in buffers for own in statistics):
                buffer.copy_(statistics[leaf])


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
