"""Network, task and data that Decision Transformer and Online Decision Transformer share."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from functools import partial
from typing import Any, TypeVar

from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.data import Bounded, Categorical, MultiCategorical, TensorSpec
from torchrl.envs import Compose, EnvBase, TargetReturn

from torchrl_tit.datasets import Episodes, SequenceStorage, load_episodes
from torchrl_tit.envs import observation_specs
from torchrl_tit.evaluation import evaluate
from torchrl_tit.frames import NormalizedFrames
from torchrl_tit.histories.decision_transformer import DecisionTransformer
from torchrl_tit.modules import DTHead, make_dt_actor
from torchrl_tit.networks import HistoryNetwork, build_network
from torchrl_tit.transforms import SequenceHistory

from ..dataset_algorithm import DatasetAlgorithm
from ..outcomes import Outcome
from ..policies import normalize_frames
from ..task import make_task, task_limit
from .settings import SequenceRecipe

RecipeT = TypeVar("RecipeT", bound=SequenceRecipe)

_EPS = 1e-6
"""What the authors of Decision Transformer add to the deviations that normalise observations."""


class Agent(nn.Module):
    """Network and head.

    Args:
        network: predicts features.
        head: maps features to actions.
    """

    def __init__(self, network: HistoryNetwork, head: DTHead) -> None:
        super().__init__()
        self.network = network
        self.head = head


class SequenceAlgorithm(DatasetAlgorithm[RecipeT]):
    """An algorithm that trains a Decision Transformer on windows of a data set.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task does not fit the network.
    """

    action_padding = -10.0
    """Value of the actions at padding; no loss reads it."""

    def __init__(self, recipe: RecipeT) -> None:
        super().__init__(recipe)
        task = make_task(recipe, num_frames=1, clip_actions=False)
        spec = _check_observation(recipe, observation_specs(task))
        shape = spec.shape
        self.action_dim = _check_task(recipe, task.action_spec_unbatched)
        task.close()
        network = build_network(recipe.backbone, shape, action_dim=self.action_dim, trunks="shared")
        assert isinstance(network, HistoryNetwork)
        if spec.dtype.is_floating_point:  # not bytes, which networks divide by 255
            normalize_frames(network, limit=math.inf, eps=_EPS)
        encoder = network.history_encoder
        assert isinstance(encoder, DecisionTransformer)
        encoder.return_scale.fill_(recipe.return_scale)
        head = DTHead(network.features_dim, self.action_dim, recipe.action_space)
        self.model = self.agent = Agent(network, head).to(self.device).eval()
        self._policy = make_dt_actor(network, head)

    @property
    def policy(self) -> TensorDictModuleBase:
        """A window of the last steps in, the newest step's action out."""
        return self._policy

    def make_env(
        self,
        num_envs: int,
        seed: int | None = None,
        *,
        target_return: float | None = None,
        **settings: Any,
    ) -> EnvBase:
        """Builds the task with everything that the policy reads; actions are passed on unchanged.

        Episodes of a task without a time limit are truncated after ``max_ep_len`` steps.

        Args:
            num_envs: number of environments, which are stepped side by side.
            seed: seed of the first environment.
            target_return: the return that the network aims for; the recipe's first one if None.
            **settings: further settings of the task.
        """
        recipe = self.recipe
        if task_limit(recipe) is None:
            settings = {"max_episode_steps": recipe.history.max_ep_len, **settings}
        env = make_task(recipe, num_envs, seed, num_frames=1, clip_actions=False, **settings)
        if target_return is None:
            target_return = recipe.target_returns[0]
        history = SequenceHistory(
            recipe.acting_num_frames or recipe.backbone.num_frames,
            return_scale=1.0,  # the network divides
        )
        return env.append_transform(Compose(TargetReturn(target_return), history))

    def load_data(self) -> Episodes:
        """Loads the data set, by whose statistics the network then normalises observations.

        Raises:
            ValueError: if its actions are of another kind, no episode is finished, or one is longer
                than the network allows.
            FileNotFoundError: if there are no such data.
        """
        recipe = self.recipe
        episodes = load_episodes(recipe.dataset, **recipe.reading())
        check_data(recipe, episodes)
        warn_of_targets(recipe.target_returns, episodes)
        for encoder in self.agent.network.frames:
            if isinstance(encoder, NormalizedFrames):
                encoder.set_statistics(*episodes.observation_statistics())
        return episodes.to(self.device)

    def make_storage(self, episodes: Episodes) -> SequenceStorage:
        """Cuts windows out of episodes."""
        recipe = self.recipe
        return SequenceStorage(
            episodes,
            recipe.backbone.num_frames,
            return_scale=1.0,
            action_padding=self.action_padding,
        )

    def play(self, step: int) -> list[Outcome]:
        """Plays the evaluation's episodes for each target return, side by side."""
        recipe = self.recipe
        return [
            Outcome(
                step,
                evaluate(
                    partial(self.make_env, target_return=target),
                    self.policy,
                    recipe.evaluation_episodes,
                    seed=recipe.evaluation_seed,
                    shrink=True,
                ).tolist(),
                target,
            )
            for target in recipe.target_returns
        ]


def check_data(recipe: SequenceRecipe, episodes: Episodes) -> None:
    """Checks that a network can be trained on episodes.

    Raises:
        ValueError: if their actions are of another kind, none is finished, or one is longer than
            the network allows.
    """
    dataset, settings = recipe.dataset, recipe.history
    continuous = episodes.rows["action"].is_floating_point()
    if continuous == (recipe.action_space == "discrete"):
        kind = "continuous" if continuous else "discrete"
        raise ValueError(
            f"the actions in {dataset} are {kind} ({episodes.rows['action'].dtype}), but the "
            f"head's are {recipe.action_space}: set action_space to {kind!r}, or use other data "
            "(discrete actions are integers)"
        )
    if not episodes.finished.any():
        raise ValueError(f"no episode in {dataset} is finished, so their returns are not known")
    longest = int(episodes.lengths[episodes.finished].max())  # the others are not trained on
    if settings.timestep_embedding and longest > settings.max_ep_len:
        raise ValueError(
            f"episodes in {dataset} have up to {longest} steps, but max_ep_len is "
            f"{settings.max_ep_len}: raise backbone.history.max_ep_len to {longest} or more"
        )


def warn_of_targets(target_returns: Sequence[float], episodes: Episodes) -> None:
    """Warns about target returns that lie outside the returns of the data's episodes."""
    returns = episodes.returns[episodes.finished.cpu()]
    low, high = returns.min().item(), returns.max().item()
    outside = [target for target in target_returns if not low <= target <= high]
    if outside:
        warnings.warn(
            f"target_returns {', '.join(f'{target:g}' for target in outside)}: no episode in "
            f"{episodes.source} has such a return; they range from {low:.1f} to {high:.1f}, with a "
            f"mean of {returns.mean().item():.1f}",
            stacklevel=2,
        )


def _check_observation(
    recipe: SequenceRecipe, spec: TensorSpec | dict[str, TensorSpec]
) -> TensorSpec:
    """Returns the spec of a task's observation.

    Raises:
        ValueError: if there are several, or it has categories.
    """
    several = isinstance(spec, dict)
    if several or isinstance(spec, MultiCategorical):
        found = f"several observations ({', '.join(spec)})" if several else "categories"
        raise ValueError(
            f"{recipe.env} has {found}, but a Decision Transformer reads one array or image: "
            "choose one with observation_keys, or flatten them with the wrapper "
            "gymnasium.wrappers:FlattenObservation"
        )
    return spec


def _check_task(recipe: SequenceRecipe, action_spec: Any) -> int:
    """Returns the entries of a continuous action, or the number of discrete ones.

    Raises:
        ValueError: if the network cannot act in the task.
    """
    env, settings = recipe.env, recipe.history
    limit = task_limit(recipe)
    if settings.timestep_embedding and limit is not None and limit > settings.max_ep_len:
        raise ValueError(
            f"episodes of {env} have up to {limit} steps, but max_ep_len is "
            f"{settings.max_ep_len}: raise backbone.history.max_ep_len to {limit} or more"
        )
    discrete = type(action_spec) is Categorical
    if not (discrete or isinstance(action_spec, Bounded)):
        raise ValueError(
            f"{env} has {type(action_spec).__name__} actions, but a Decision Transformer takes "
            "one choice (Discrete) or a vector within bounds (Box): use a ppo recipe"
        )
    if discrete != (recipe.action_space == "discrete"):
        kind = "discrete" if discrete else "continuous"
        raise ValueError(
            f"{env} has {kind} actions, but the head's are {recipe.action_space}: set action_space "
            f"to {kind!r}, or use another task"
        )
    if isinstance(action_spec, Bounded):
        bounds = [x.flatten().tolist() for x in (action_spec.low, action_spec.high)]
        for low, high in zip(*bounds, strict=True):
            if (low, high) != (-1, 1):
                raise ValueError(
                    f"actions of {env} range from {low:g} to {high:g}, but the head's from -1 to "
                    "1: use a task in which all of them range from -1 to 1"
                )
    return action_spec.space.n if discrete else action_spec.shape[0]
