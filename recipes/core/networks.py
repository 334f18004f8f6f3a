"""Backbones, policies and critics of the algorithms, besides those of torchrl_tit.modules."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    AddStateIndependentNormalScale,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.data import Bounded, Categorical, TensorSpec
from torchrl.envs import Compose, EnvBase
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, QValueModule, TanhModule

from torchrl_tit.envs import observation_specs
from torchrl_tit.frames import NormalizedFrames, share_statistics
from torchrl_tit.frames.observation import Observation, Observations, read_observations
from torchrl_tit.layers.images import bytes_to_floats
from torchrl_tit.modules import Backbone, as_sequences, history_keys, make_actor
from torchrl_tit.modules.action_specs import describe, half_range, has_bounds
from torchrl_tit.modules.backbone import trunks_of
from torchrl_tit.modules.sequences import default_observation_keys
from torchrl_tit.modules.tensor_module import TensorModule, TensorValue
from torchrl_tit.networks import HistoryNetwork, build_network, chosen_by_kind
from torchrl_tit.settings import Flat, Network

from .algorithm import Algorithm, Terms, check_without_waiting
from .recipe import Recipe

_MIN_LOG_STD = -5.0


def make_backbone(
    network: Network,
    observation: Observations,
    *,
    out_key: str = "features",
    slices: bool = False,
    normalization: Mapping[str, Any] | None = None,
) -> Backbone:
    """Builds the backbone of an actor or of a critic.

    Args:
        network: its settings.
        observation: spec of the observation, or of each by name.
        out_key: key of the features.
        slices: whether it reads slices of consecutive steps [..., T] in TorchRL's recurrent mode;
            it then also reads the observations and "is_init".
        normalization: if given, it normalizes observations with these settings of
            :class:`~torchrl_tit.frames.NormalizedFrames`.
    """
    histories = history_keys(observation)
    built = build_network(network, observation, trunks="shared")
    if normalization is not None:
        normalize_frames(built, **normalization)
    return Backbone(
        built,
        in_keys=histories,
        out_keys=[out_key],
        observation_keys=default_observation_keys(histories) if slices else None,
    )


def normalize_frames(network: nn.Module, **settings: Any) -> None:
    """Puts a :class:`NormalizedFrames` in front of each frame encoder but those of categories.

    Args:
        network: the network, with one trunk or two.
        **settings: those of :class:`NormalizedFrames`.
    """
    for trunk in trunks_of(network).values():
        names = list(trunk.frame_encoders)
        seen = zip(names, trunk.frames, trunk.observations.values(), strict=True)
        for key, encoder, observation in seen:
            if observation.categories is None:
                trunk.frame_encoders[key] = NormalizedFrames(encoder, **settings)


def set_statistics(
    policy: nn.Module, model: nn.Module, change: Callable[[NormalizedFrames], None]
) -> None:
    """Sets the statistics of all networks: the policy's, the critics' and the targets'.

    Args:
        policy: reads one observation, normalized.
        model: a TorchRL loss, which stacks the statistics of the critics.
        change: updates or replaces the policy's.
    """
    (frames,) = (m for m in policy.modules() if isinstance(m, NormalizedFrames))
    change(frames)
    share_statistics(frames, model)


def check_normalizes(task: str, observation: Any) -> None:
    """Raises ValueError unless a task has one observation, and this is of floats.

    Args:
        task: its name.
        observation: spec of the observation, or of each by name.
    """
    several = isinstance(observation, dict)
    if several or not observation.dtype.is_floating_point:
        found = "several" if several else f"{observation.dtype}, not floats"
        raise ValueError(
            f"normalize_observations is on, but observations of {task} are {found}: switch it off"
        )


def make_cloning_policy(
    backbone: Backbone, action_spec: TensorSpec
) -> ProbabilisticTensorDictSequential:
    """Builds a policy that gives every action in a data set a finite likelihood.

    Bounded actions have a Gaussian whose mean is kept within the bounds by a tanh, and whose
    standard deviation does not depend on the state, and begins at half the range (Kostrikov et al.,
    arXiv 2110.06169, and its authors' code). A squashed Gaussian's density is 0 at the bounds,
    where data sets have many actions. Other actions use the head of
    :func:`~torchrl_tit.modules.make_actor`.

    Args:
        backbone: the backbone.
        action_spec: spec of an action, without batch dimensions.

    Raises:
        ValueError: if there is no head for the actions.
    """
    if not has_bounds(action_spec):
        return ProbabilisticTensorDictSequential(
            backbone, *make_actor(backbone.features_dim, action_spec)
        )
    mean = _bounded(backbone, action_spec, "loc")
    scale = ScaleInUnits(action_spec)
    return ProbabilisticActor(
        TensorDictSequential(*mean, TensorModule(scale, ["loc"], ["loc", "scale"])),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        distribution_kwargs={"validate_args": False},
    )


def make_deterministic_policy(backbone: Backbone, action_spec: Bounded) -> TensorDictSequential:
    """Builds a policy whose action is linear in the features, kept within its bounds by a tanh.

    Args:
        backbone: the backbone.
        action_spec: bounds of an action, without batch dimensions.
    """
    return TensorDictSequential(*_bounded(backbone, action_spec, "action"))


def make_value_policy(
    backbone: Backbone, action_spec: Categorical, *, mask_key: str | None = None
) -> TensorDictSequential:
    """Builds a policy that takes the action with the highest value, which a linear layer predicts.

    Args:
        backbone: the backbone.
        action_spec: spec of an action, without batch dimensions.
        mask_key: key of the mask of allowed actions, if the policy reads it.
    """
    values = nn.Linear(backbone.features_dim, action_spec.space.n)
    head = TensorModule(values, ["features"], ["action_value"])
    choice = QValueModule(spec=action_spec, action_mask_key=mask_key)
    return TensorDictSequential(backbone, head, choice)


def make_critic(
    observation: Observations,
    action: TensorSpec | None,
    hidden: Sequence[int],
    network: Network | None = None,
    *,
    values: int = 1,
    out_key: str = "state_action_value",
    slices: bool = False,
    normalization: Mapping[str, Any] | None = None,
) -> TensorDictModuleBase:
    """Builds an MLP on the newest observation or a backbone's features, and on the action, if any.

    Args:
        observation: spec of the observation, or of each by name.
        action: spec of an action [A], which the MLP reads in units of its bounds, from -1 to 1, if
            it has any; None if it is not read.
        hidden: widths of the MLP's hidden layers.
        network: settings of the backbone; if None, the MLP reads the newest observation.
        values: number of values, such as one for each discrete action.
        out_key: key of the values.
        slices: whether the backbone reads slices of consecutive steps [..., T] in TorchRL's
            recurrent mode; it then also reads "observation" and "is_init".
        normalization: as in :func:`make_backbone`; normalizes what an MLP reads, too.

    Returns:
        A module that reads "observation" [..., D], or "history" [..., K, *obs], and "action"
        [..., A], and writes ``out_key``, float [..., values].

    Raises:
        ValueError: if there is no backbone, and the observation is not a single array.
    """
    modules: list[TensorDictModuleBase] = []
    if network is not None:
        key = "critic_features"
        shared: dict[str, Any] = {"slices": slices, "normalization": normalization}
        backbone = make_backbone(network, observation, out_key=key, **shared)
        modules, size = [backbone], backbone.features_dim
    else:
        key, array = "observation", _only_array(observation)
        size = array.entries
        if normalization is not None:
            frames = NormalizedFrames(Flat().build((size,)), **normalization)
            flat = nn.Sequential(frames, nn.Flatten(-2))
            modules, key = [TensorModule(flat, [key], ["normalized"])], "normalized"
        elif array.dtype == torch.uint8:  # as frame encoders read bytes
            modules, key = [TensorModule(bytes_to_floats, [key], ["floats"])], "floats"
    in_units = action is not None and has_bounds(action) and not _are_units(action)
    mlp = (partial(ActionMLP, action) if in_units else MLP)(
        size + (0 if action is None else action.shape[0]),
        values,
        num_cells=list(hidden),
        activation_class=nn.ReLU,
        activation_kwargs={"inplace": True},
    )
    in_keys = [key] if action is None else [key, "action"]
    return TensorDictSequential(*modules, TensorValue(mlp, in_keys=in_keys, out_keys=[out_key]))


def state_transforms(policy: nn.Module) -> Compose:
    """Makes the transforms that carry a policy's state through an environment, if it has one."""
    backbones = (module for module in policy.modules() if isinstance(module, Backbone))
    return next((backbone.make_transforms() for backbone in backbones), Compose())


def arranging(recipe: Recipe) -> Callable[[TensorDictBase], TensorDictBase] | None:
    """Returns how a recipe arranges slices of steps for its network, if that carries a state.

    Args:
        recipe: the settings, with a ``burn_in`` if the network carries a state.
    """
    if not recipe.backbone.carries_state:
        return None
    return partial(as_sequences, burn_in=getattr(recipe, "burn_in", 0))


def is_continuous(spec: TensorSpec) -> bool:
    """Whether actions are arrays of floats."""
    return spec.dtype.is_floating_point and spec.ndim == 1


def is_discrete(spec: TensorSpec) -> bool:
    """Whether an action is a single discrete choice; TorchRL's specs of several are subclasses."""
    return type(spec) is Categorical and spec.ndim == 0


def check_actions(recipe: Recipe, spec: TensorSpec, fit: bool, needed: str, instead: str) -> None:
    """Raises ValueError unless the actions of a recipe's task fit its algorithm.

    Args:
        recipe: the recipe.
        spec: spec of an action.
        fit: whether they do.
        needed: the actions that the algorithm needs, in words.
        instead: other recipes, in words.
    """
    if not fit:
        raise ValueError(
            f"{recipe.algorithm} needs {needed}, but those of {recipe.task_name} are "
            f"{describe(spec)}: use {instead}"
        )


def target_entropy(bounds: Bounded) -> float:
    """Minus the number of an action's entries, in nats, as in SAC (arXiv 1812.05905).

    That is for actions from -1 to 1: a wider range adds its logarithm.
    """
    return half_range(bounds).log().sum().item() - bounds.shape[0]


def _are_units(bounds: Bounded) -> bool:
    return bool((bounds.space.low == -1).all() and (bounds.space.high == 1).all())


class ScaleInUnits(AddStateIndependentNormalScale):
    """Standard deviations [A], which begin at half the range of each entry."""

    def __init__(self, bounds: Bounded) -> None:
        super().__init__(bounds.shape[0], scale_lb=math.exp(_MIN_LOG_STD))
        units = _are_units(bounds)  # whose checkpoints need no buffer
        self.register_buffer("half_range", None if units else half_range(bounds))

    def forward(self, loc: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
        """Writes the deviations beside the means, float [..., A] each."""
        loc, scale, *others = super().forward(loc, *others)
        return loc, scale if self.half_range is None else scale * self.half_range, *others


class ActionMLP(MLP):
    """An MLP that reads actions [..., A] in units of their bounds, from -1 to 1.

    Its weights have the names of those of an MLP, so critics can start from those of other units.
    """

    middle: Tensor
    half_range: Tensor

    def __init__(self, bounds: Bounded, *sizes: int, **layers: Any) -> None:
        super().__init__(*sizes, **layers)
        self.register_buffer("middle", (bounds.space.high + bounds.space.low) / 2)
        self.register_buffer("half_range", half_range(bounds))

    def forward(self, *inputs: Tensor) -> Tensor:
        """Maps features [..., F] and actions to values, float [..., values]."""
        features, action = inputs
        return super().forward(features, (action - self.middle) / self.half_range)


def _bounded(backbone: Backbone, action_spec: Bounded, key: str) -> list[nn.Module]:
    """A backbone, a linear layer, and a tanh that is scaled to the bounds."""
    linear = nn.Linear(backbone.features_dim, action_spec.shape[0])
    space = action_spec.space
    return [
        backbone,
        TensorModule(linear, ["features"], [key]),
        TanhModule(in_keys=[key], low=space.low, high=space.high),
    ]


def _only_array(observation: Observations) -> Observation:
    """Returns the only observation, which must be an array."""
    read = read_observations(observation)
    first = next(iter(read.values()))
    if len(read) > 1:
        raise ValueError(
            f"an MLP cannot value several observations ({', '.join(read)}): set critic to "
            "'backbone'"
        )
    if first.kind != "array":
        kind = "images" if first.kind == "image" else first.kind
        raise ValueError(f"an MLP cannot value {kind} {first.shape}: set critic to 'backbone'")
    return first


def name_chosen_encoders(algorithm: Algorithm[Any]) -> tuple[Recipe, str]:
    """Adds to an algorithm's recipe the frame encoders chosen by the kinds of observations.

    The run's recipe.json then records them, and a resumed run keeps them in later versions too.

    Returns:
        The recipe for the run, which also has what the algorithm took from its data, and a
        description of what was chosen, which is empty if nothing was.
    """
    recipe = algorithm.recipe
    modules = algorithm.policy.modules()
    network = next((module for module in modules if isinstance(module, HistoryNetwork)), None)
    chosen = {} if network is None else network.frame_settings
    if not (described := chosen_by_kind(recipe.backbone, chosen)):
        return recipe, ""
    return replace(recipe, backbone=replace(recipe.backbone, frames=chosen)), described


class LearnsFromSamples(ABC):
    """What algorithms have in common that learn from samples of transitions.

    Their model is the loss, with the weights of all networks, the policy's among them.
    """

    recipe: Any
    device: torch.device
    columns: Sequence[str]
    optional_columns: Sequence[str]
    normalized_by: ClassVar[Mapping[str, float]] = {}
    """Settings of what normalizes observations, if the recipe says so."""
    _policy: TensorDictModuleBase

    @abstractmethod
    def networks(self, env: EnvBase) -> nn.Module:
        """Builds the loss with all networks: the policy, critics, and what a subclass adds to it.

        Args:
            env: the task, for its observations and actions.
        """

    @abstractmethod
    def loss(self, samples: TensorDictBase) -> Terms:
        """Returns the terms of the loss, float [] each.

        Those whose names begin with "loss_" are added up and trained on; the others are metrics. To
        add one, override this method and call it first.

        Args:
            samples: transitions [B], or slices of consecutive ones, [N, T].
        """

    @property
    def policy(self) -> TensorDictModuleBase:
        """The policy, from histories to actions; its weights are among those of the model."""
        return self._policy

    @property
    def normalization(self) -> Mapping[str, float] | None:
        """Settings of what normalizes the observations that networks read; None if nothing does."""
        return self.normalized_by if self.recipe.normalize_observations else None

    def make_backbone(self, env: EnvBase, *, slices: bool = False) -> Backbone:
        """Builds the policy's backbone.

        Args:
            env: the task.
            slices: as in :func:`make_backbone`; always on if the recipe draws slices.
        """
        recipe, slices = self.recipe, slices or self.recipe.slice_length > 1
        observation = observation_specs(env)
        return make_backbone(
            recipe.backbone, observation, slices=slices, normalization=self.normalization
        )

    def make_critic(
        self, env: EnvBase, action: TensorSpec | None, **settings: Any
    ) -> TensorDictModuleBase:
        """Builds a value network on the networks' device; see :func:`make_critic`."""
        recipe = self.recipe
        return make_critic(
            observation_specs(env),
            action,
            recipe.critic_hidden,
            recipe.critic_backbone,
            slices=recipe.slice_length > 1,
            normalization=self.normalization,
            **settings,
        ).to(self.device)

    def numbers(self, terms: Terms) -> dict[str, Tensor]:
        """Selects and checks the numbers that an update returns from the terms of its losses.

        An optional one that the update did not compute is NaN.
        """
        names = [x for x in self.columns if x in terms or x not in self.optional_columns]
        values = torch.stack([terms[name].detach() for name in names])
        check_without_waiting(names, values)
        found = dict(zip(names, values, strict=True))
        absent = [name for name in self.columns if name not in found]
        return found | {name: torch.full_like(values[0], math.nan) for name in absent}
