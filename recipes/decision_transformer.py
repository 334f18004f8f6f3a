"""Decision Transformer: settings, then the algorithm. Online Decision Transformer builds on it.

To change it, subclass DT and DTAlgorithm and override ``networks`` or ``loss``.
"""

from __future__ import annotations

import math
import warnings
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Bounded, Categorical, MultiCategorical, ReplayBuffer, TensorSpec
from torchrl.envs import Compose, EnvBase, TargetReturn

from torchrl_tit import settings
from torchrl_tit.datasets import Episodes, SequenceStorage, make_replay_buffer, select_episodes
from torchrl_tit.envs import observation_specs
from torchrl_tit.evaluation import evaluate
from torchrl_tit.frames import NormalizedFrames
from torchrl_tit.histories.decision_transformer import DecisionTransformer
from torchrl_tit.modules import DTHead, make_dt_actor, make_dt_predictor
from torchrl_tit.modules.decision_transformer import ActionPredictor
from torchrl_tit.networks import HistoryNetwork, build_network
from torchrl_tit.objectives import MaskedDTLoss
from torchrl_tit.settings.networks import decision_transformer
from torchrl_tit.settings.numbers import (
    Batch,
    Frames,
    Positive,
    Rate,
    Real,
    Steps,
    StepsOrNone,
    Weight,
)
from torchrl_tit.settings.numbers import Episodes as EpisodeCount
from torchrl_tit.transforms import SequenceHistory

from .core.algorithm import Stateful, Terms, check_without_waiting, storage_device, total_loss
from .core.evaluation import Outcome
from .core.networks import normalize_frames
from .core.numbers import number
from .core.recipe import DatasetRecipe
from .core.task import make_task, task_limit
from .offline import DatasetAlgorithm, action_error, read_data

ActionSpace = Literal["continuous", "gaussian", "discrete"]

_EPS = 1e-6
"""What the authors of Decision Transformer add to the deviations that normalize observations."""


@dataclass(frozen=True, kw_only=True)
class SequenceRecipe(DatasetRecipe):
    """Settings of every recipe that trains a Decision Transformer on a data set."""

    supplies_actions: ClassVar[bool] = True

    backbone: settings.Network = field(default_factory=decision_transformer)
    """The network: linear frames (DT) or an inner transformer (DT_TIT), and a decision-transformer
    as the history encoder. Its number of frames is that of a training window."""
    action_space: ActionSpace = "continuous"
    """How actions are predicted: "continuous" predicts actions within -1..1 with a tanh; "gaussian"
    predicts the mean and standard deviation of a tanh-squashed Gaussian; "discrete" predicts
    logits."""
    target_returns: tuple[Real, ...] = ()
    """Target returns of the evaluations; by default the highest of the data's whole episodes."""
    return_scale: Positive = 1000.0
    """Divisor of the returns-to-go."""
    acting_num_frames: Frames | None = None
    """Number of steps that the network reads when it acts; the length of a training window by
    default and at most."""
    full_windows: bool = False
    """Whether windows that would pass their episode's end begin earlier, so that fewer are padded.
    Windows as long as episodes then all begin with the first step, as when the agent acts."""
    batch_size: Batch = 64
    """Windows in one gradient step."""
    learning_rate: Rate = 1e-4
    """Learning rate after warm-up."""
    warmup_updates: StepsOrNone = 10_000
    """Gradient steps over which the learning rate rises linearly."""
    weight_decay: Weight = 1e-4
    """Weight decay, on every parameter."""
    max_grad_norm: Weight = 0.25
    """Maximum gradient norm; larger gradients are scaled down to it."""
    evaluation_episodes: EpisodeCount = 100
    """Episodes for each target return, in every evaluation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.backbone.history, settings.DecisionTransformer):
            raise ValueError(
                f"backbone.history is {self.backbone.history.name}, but this recipe trains a "
                "decision-transformer: choose another frame encoder, not another history encoder"
            )
        if (self.acting_num_frames or 0) > self.backbone.num_frames:
            raise ValueError(
                f"acting_num_frames must be at most {self.backbone.num_frames}, not "
                f"{self.acting_num_frames}"
            )
        if len(set(self.target_columns.values())) < len(self.target_returns):
            raise ValueError(
                f"target_returns must differ within six digits, unlike {self.target_returns}"
            )

    @property
    def history(self) -> settings.DecisionTransformer:
        """The settings of the history encoder."""
        assert isinstance(self.backbone.history, settings.DecisionTransformer)
        return self.backbone.history

    @property
    def target_columns(self) -> dict[float | None, str]:
        """Columns of metrics that hold the mean return for each target return."""
        return {target: f"return_{target:g}" for target in self.target_returns}

    def learning_rate_at(self, step: int) -> float:
        """Returns the learning rate of the gradient step after ``step`` others."""
        return self.learning_rate * min((step + 1) / max(self.warmup_updates, 1), 1)


RecipeT = TypeVar("RecipeT", bound=SequenceRecipe)


class SequenceAlgorithm(DatasetAlgorithm[RecipeT]):
    """An algorithm that trains a Decision Transformer on windows of a data set.

    Args:
        recipe: the settings.

    Raises:
        ValueError: if the task does not fit the network.
    """

    action_padding = -10.0
    """Value of the actions at padding; no loss reads it."""

    model: ActionPredictor

    def __init__(self, recipe: RecipeT) -> None:
        super().__init__(recipe)
        recipe = self.recipe
        if not recipe.target_returns:
            episodes = read_data(recipe)
            check_data(recipe, episodes)
            best = episodes.returns[episodes.whole].max().item()
            self.recipe = recipe = replace(recipe, target_returns=(best,))
        with closing(make_task(recipe, num_frames=1, clip_actions=False)) as task:
            self.model = self.networks(task).to(self.device).eval()
        self._policy = make_dt_actor(self.model.network, self.model.head)

    def networks(self, env: EnvBase) -> ActionPredictor:
        """Builds network and head, and what a subclass adds to them.

        Args:
            env: the task, for its observations and actions.
        """
        recipe = self.recipe
        spec = _check_observation(recipe, observation_specs(env))
        self.action_dim = _check_task(recipe, env.action_spec_unbatched)
        network = build_network(
            recipe.backbone, spec.shape, action_dim=self.action_dim, trunks="shared"
        )
        assert isinstance(network, HistoryNetwork)
        if spec.dtype.is_floating_point:  # not bytes, which networks divide by 255
            normalize_frames(network, limit=math.inf, eps=_EPS)
        encoder = network.history_encoder
        assert isinstance(encoder, DecisionTransformer)
        encoder.return_scale.fill_(recipe.return_scale)
        return ActionPredictor(
            network, DTHead(network.features_dim, self.action_dim, recipe.action_space)
        )

    @abstractmethod
    def loss(self, samples: TensorDictBase) -> Terms:
        """Returns the terms of the loss, float [] each.

        Those whose names begin with "loss_" are added up and trained on; the others are metrics. To
        add one, override this method and call it first.

        Args:
            samples: windows [B].
        """

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
        if recipe.env and task_limit(recipe) is None:
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
        """Loads the data set, by whose statistics the network then normalizes observations.

        Raises:
            ValueError: if its actions are of another kind, no episode is finished, or one is longer
                than the network allows.
            FileNotFoundError: if there are no such data.
        """
        recipe = self.recipe
        episodes = read_data(recipe)
        check_data(recipe, episodes)
        warn_of_targets(recipe.target_returns, episodes)
        episodes = self.split(episodes)
        for encoder in self.model.network.frames:
            if isinstance(encoder, NormalizedFrames):
                encoder.set_statistics(*episodes.observation_statistics(encoder.samples))
        return episodes.to(storage_device(recipe))

    def split(self, episodes: Episodes) -> Episodes:
        """Leaves out unfinished episodes and parts of others, and holds some of the rest out.

        Raises:
            ValueError: if some are to be held out of a single episode, whose parts would not have
                its return.
        """
        whole = episodes.whole
        if self.recipe.held_out_fraction and len(whole) == 1:
            raise ValueError(
                f"{episodes.source} has a single whole episode, of which no part can be held out "
                "(validation_fraction), because its return would be another: record more"
            )
        if len(whole) < len(episodes.lengths):
            episodes = select_episodes(episodes, whole)
        return super().split(episodes)

    def measured_items(self, episodes: Episodes) -> SequenceStorage:
        """Cuts windows out of episodes, as in training."""
        recipe = self.recipe
        return SequenceStorage(
            episodes,
            recipe.backbone.num_frames,
            return_scale=1.0,
            action_padding=self.action_padding,
            full=recipe.full_windows,
        )

    def measure_batch(self, samples: TensorDictBase) -> Mapping[str, Tensor]:
        """Compares the predicted actions with the data's, at all steps of the windows."""
        actor = make_dt_actor(self.model.network, self.model.head, group=None, every_frame=True)
        chosen, mask = actor(samples.copy())["action"], samples["mask"]
        return {"action_error": action_error(chosen[mask], samples["action"][mask])}

    def play(self, step: int) -> list[Outcome]:
        """Plays the evaluation's episodes for each target return, side by side."""
        recipe = self.recipe
        if not recipe.env:
            return []
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


@dataclass(frozen=True, kw_only=True)
class DT(SequenceRecipe, algorithm="dt"):
    """Decision Transformer (arXiv 2106.01345) on a data set.

    The defaults are those of its paper's MuJoCo runs, which arXiv 2212.14538 repeats with DT_TIT.
    """

    length: ClassVar[str] = "iterations"

    iterations: Steps = 10
    """Number of iterations; each ends with an evaluation."""
    updates_per_iteration: Steps = 10_000
    """Gradient steps in an iteration."""

    def build(self) -> DTAlgorithm:
        """Builds the algorithm."""
        return DTAlgorithm(self)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.action_space == "gaussian":
            raise ValueError(
                "action_space is 'gaussian', which this loss cannot train: use 'continuous', or an "
                "odt recipe"
            )

    @property
    def final_step(self) -> int:
        """Gradient steps of the whole run."""
        return self.iterations * self.updates_per_iteration

    def evaluation_due(self, before: int, step: int) -> bool:
        """Returns whether an iteration ends at a gradient step."""
        return step % self.updates_per_iteration == 0


class DTAlgorithm(SequenceAlgorithm[DT]):
    """Decision Transformer: AdamW on the error of the predicted actions.

    Args:
        recipe: the settings.
    """

    columns = ("loss", "gradient_norm", "learning_rate")

    def prepare(self, step: int, folder: Path) -> None:
        """Builds replay buffer, loss and optimizer."""
        recipe, agent = self.recipe, self.model.train()
        self.buffer = self.make_buffer()
        self.dt_loss = MaskedDTLoss(
            make_dt_predictor(agent.network, agent.head),
            loss_function="cross_entropy" if recipe.action_space == "discrete" else "l2",
        )
        self.optimizer = torch.optim.AdamW(
            agent.parameters(),
            lr=recipe.learning_rate,
            weight_decay=recipe.weight_decay,
            fused=True,
        )

    def make_buffer(self) -> ReplayBuffer:
        """Reads the data set into a replay buffer of windows."""
        storage = self.measured_items(self.load_data())
        return make_replay_buffer(storage, self.recipe.batch_size, seed=self.recipe.seed)

    def state(self) -> Mapping[str, Stateful]:
        """Optimizer, and the sampling state of the replay buffer."""
        return {"optimizer": self.optimizer, "buffer": self.buffer}

    def loss(self, samples: TensorDictBase) -> Terms:
        """Returns the terms of the loss; see :meth:`SequenceAlgorithm.loss`."""
        return {"loss_action": self.dt_loss(samples)["loss"]}

    def update(self, batch: TensorDictBase, step: int) -> Mapping[str, Tensor | float]:
        """Takes a gradient step on windows [B]."""
        learning_rate = self.recipe.learning_rate_at(step)
        self.optimizer.param_groups[0]["lr"] = learning_rate
        loss = total_loss(self.loss(batch))
        self.optimizer.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), self.recipe.max_grad_norm)
        check_without_waiting(self.columns[:2], torch.stack([loss.detach(), norm]))
        self.optimizer.step()
        return {"loss": loss.detach(), "gradient_norm": norm, "learning_rate": learning_rate}


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
    longest = int(episodes.lengths[episodes.whole].max())  # the others are not trained on
    if settings.timestep_embedding and longest > settings.max_ep_len:
        raise ValueError(
            f"episodes in {dataset} have up to {longest} steps, but max_ep_len is "
            f"{settings.max_ep_len}: raise backbone.history.max_ep_len to {longest} or more"
        )


def warn_of_targets(target_returns: Sequence[float], episodes: Episodes) -> None:
    """Warns about target returns that lie outside the returns of the data's episodes."""
    returns = episodes.returns[episodes.whole]
    low, high = returns.min().item(), returns.max().item()
    outside = [target for target in target_returns if not low <= target <= high]
    if outside:
        warnings.warn(
            f"target_returns {', '.join(f'{target:g}' for target in outside)}: no episode in "
            f"{episodes.source} has such a return; they range from {number(low)} to "
            f"{number(high)}, with a mean of {number(returns.mean().item())}",
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
            f"{recipe.task_name} has {found}, but a Decision Transformer reads one array or image: "
            "choose one with observation_keys, or flatten them with the wrapper "
            "gymnasium.wrappers:FlattenObservation"
        )
    return spec


def _check_task(recipe: SequenceRecipe, action_spec: Any) -> int:
    """Returns the entries of a continuous action, or the number of discrete ones.

    Raises:
        ValueError: if the network cannot act in the task.
    """
    env, settings = recipe.task_name, recipe.history
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
