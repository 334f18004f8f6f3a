"""The parts of a policy, and what it reads from an environment, for export."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
    set_interaction_type,
)
from tensordict.nn.probabilistic import InteractionType
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Transform
from torchrl.modules import QValueModule

from torchrl_tit.modules.acting import modules_in_order, trunks_of
from torchrl_tit.modules.backbone import Backbone
from torchrl_tit.modules.distributions import IndependentBernoulli
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.settings.choices import Padding
from torchrl_tit.transforms import History, SequenceHistory
from torchrl_tit.transforms.hide_velocities import HideEntries


@dataclass(frozen=True)
class Entry:
    """A tensor that an exported policy reads or writes."""

    shape: tuple[int, ...]
    """Its shape, without the batch."""
    dtype: torch.dtype

    def zeros(self, size: int) -> Tensor:
        """Returns zeros, [size, *shape]."""
        return torch.zeros(size, *self.shape, dtype=self.dtype)


class Select(nn.Module):
    """Selects some entries of the last dimension.

    Args:
        entries: their indices.
    """

    entries: Tensor

    def __init__(self, entries: Sequence[int]) -> None:
        super().__init__()
        self.register_buffer("entries", torch.tensor(entries))

    def forward(self, observation: Tensor) -> Tensor:
        """[..., D] -> [..., entries]."""
        return observation.index_select(-1, self.entries)


@dataclass(frozen=True)
class Observed:
    """An observation of a task, before velocities are hidden."""

    suffix: str
    """Suffix of the argument's name: "_NAME" if there are several observations."""
    key: NestedKey
    """The key under which the environment writes it."""
    entry: Entry
    """Shape and dtype of one observation."""
    layers: nn.Sequential
    """The environment's operations on it before the network reads it."""
    place: int
    """Number of the environment's transforms before the first of these."""
    padding: Padding | None
    """Padding before an episode; None if it is masked."""


def transforms_of(env: EnvBase) -> list[Transform]:
    """Lists the transforms of an environment, the innermost first."""
    if not isinstance(env, TransformedEnv):
        return []
    transform = env.transform
    return list(getattr(transform, "transforms", [transform]))


def trace_observation(env: EnvBase, history_key: NestedKey, suffix: str = "") -> Observed:
    """Finds the observation from which a history is made.

    Args:
        env: the environment that writes it.
        history_key: its key.
        suffix: suffix of the argument's name.

    Raises:
        ValueError: if no :class:`~torchrl_tit.transforms.History` writes it.

    Example:
        >>> from torchrl_tit.envs import make_env
        >>> env = make_env("CartPole-v1", num_frames=4, hide_velocities=True)
        >>> seen = trace_observation(env, "history")
        >>> seen.entry.shape, seen.layers(torch.tensor([0.0, 1.0, 2.0, 3.0]))
        ((4,), tensor([0., 2.]))
    """
    transforms = transforms_of(env)
    key, place = unravel_key(history_key), len(transforms)
    layers: list[nn.Module] = []
    padding: Padding | None = None
    stacked, size = False, None
    for index in reversed(range(len(transforms))):
        transform = transforms[index]
        outs = [unravel_key(out) for out in transform.out_keys or ()]
        if isinstance(transform, SequenceHistory):
            if key in ((out, "observation") for out in outs):
                key, stacked = unravel_key(transform.in_keys[0]), True
                place = index
            continue
        if key not in outs:
            continue
        source = unravel_key(transform.in_keys[outs.index(key)])
        if isinstance(transform, History):
            padding, stacked = transform.padding, True
        elif isinstance(transform, HideEntries):
            shape = env.observation_spec[history_key].shape
            size = shape[-1] + len(transform.hidden)
            layers.append(Select([i for i in range(size) if i not in transform.hidden]))
        else:
            break  # this one writes the observation
        key, place = source, index
    if not stacked:
        raise ValueError(
            f"no History of the environment writes {history_key!r}, so it is not known what the "
            "policy reads: make the environment with torchrl_tit.envs.make_env and its "
            "append_transform, or add History to the outermost TransformedEnv"
        )
    spec = env.observation_spec[history_key]
    shape = tuple(spec.shape[env.ndim + 1 :])
    if size is not None:
        shape = (*shape[:-1], size)
    entry = Entry(shape, spec.dtype)
    return Observed(suffix, key, entry, nn.Sequential(*reversed(layers)), place, padding)


def identifiers(names: Sequence[str]) -> list[str]:
    """Turns names into unique argument names.

    Example:
        >>> identifiers(["arm/left", "arm.left", "image"])
        ['arm_left', 'arm_left_', 'image']
    """
    made: list[str] = []
    for name in names:
        argument = re.sub(r"\W", "_", name)
        while argument in made:
            argument += "_"
        made.append(argument)
    return made


class ActionHead(nn.Module):
    """The modules of a policy that map features to an action, and no others.

    By default, it takes the most likely action. A sample is the most likely action after noise was
    added to the parameters of the distribution: a Gumbel variable to logits (a logistic one for
    binary actions), or a standard normal one times the standard deviation to a mean. So a sampling
    policy is also a pure function, which gives the same samples in every runtime, and acts
    deterministically with zero noise. (Maddison et al., "A* Sampling", arXiv 1411.0030, section 2,
    describe the first; the others are inverse distribution functions.)

    Args:
        modules: all modules of a policy after its backbone, in order.

    Raises:
        ValueError: if none of them writes the action.
    """

    def __init__(self, modules: Sequence[TensorDictModuleBase]) -> None:
        super().__init__()
        if not any("action" in map(unravel_key, module.out_keys) for module in modules):
            raise ValueError("the policy writes no 'action' behind its backbone")
        # A critic, for example, is left out.
        used = TensorDictSequential(*modules).select_subsequence(out_keys=["action"])
        self.reads: set[NestedKey] = {unravel_key(key) for key in used.in_keys}
        """Keys that the modules read: features, masks."""
        *layers, last = used.module
        chooses = isinstance(last, ProbabilisticTensorDictModule | QValueModule)
        self.layers = nn.ModuleList(layers if chooses else [*layers, last])
        self.choice = last if chooses else None
        """The module that maps a distribution's parameters, or the values of actions, to an
        action."""

    @property
    def noise(self) -> str | None:
        """The kind of noise, by the name of NumPy's generator; None if actions are not sampled."""
        if not isinstance(self.choice, ProbabilisticTensorDictModule):
            return None
        if self.choice.distribution_class is IndependentBernoulli:
            return "logistic"
        return "gumbel" if "logits" in self.choice.in_keys else "standard_normal"

    @property
    def parameter_keys(self) -> list[str]:
        """Keys on which the choice depends: "logits", "loc" and "scale", or "action_value"."""
        if self.choice is None:
            return []
        known = ("logits", "loc", "scale", "action_value")
        return [key for key in known if key in self.choice.in_keys]

    def forward(
        self, entries: Mapping[NestedKey, Tensor], noise: Tensor | None = None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Maps features to actions.

        Args:
            entries: the entries that ``reads`` lists, [N, ...] each.
            noise: noise with the shape of the logits or the mean; None for the most likely action.

        Returns:
            The action [N, ...], and the entries that ``parameter_keys`` lists.
        """
        tensordict: TensorDictBase = TensorDict(dict(entries))
        for layer in self.layers:
            tensordict = layer(tensordict)
        parameters = {key: tensordict.get(key) for key in self.parameter_keys}
        return self.choose(tensordict, noise), parameters

    def choose(self, tensordict: TensorDictBase, noise: Tensor | None = None) -> Tensor:
        """Chooses an action, given the parameters of the distribution and, if any, the mask."""
        if self.choice is not None:
            if noise is not None:
                key = "logits" if "logits" in tensordict.keys() else "loc"  # noqa: SIM118
                scale = 1 if key == "logits" else tensordict["scale"]
                tensordict = tensordict.copy()
                tensordict.set(key, tensordict.get(key) + scale * noise)
            with set_interaction_type(InteractionType.DETERMINISTIC):
                tensordict = self.choice(tensordict)
        return tensordict.get("action")


@dataclass(frozen=True)
class Parts:
    """The parts of a policy, and its inputs in an environment."""

    backbone: Backbone
    trunk: HistoryNetwork
    """The network of the action; a separate network of the value is left out."""
    features_key: NestedKey
    head: ActionHead
    observed: Sequence[Observed]
    """The observations, in the order of the network."""
    further: Mapping[str, NestedKey]
    """Keys of the head's other inputs from the environment, such as masks, by name of the input."""
    entries: Mapping[str, Entry]
    """Shapes and dtypes of these."""
    to_task: Callable[[Tensor], Tensor]
    """Converts actions to those of the task."""
    action: Entry
    """An action of the policy."""
    sequence: SequenceHistory | None
    """The transform that writes the windows of a Decision Transformer."""


def read_parts(policy: nn.Module, env: EnvBase) -> Parts:
    """Splits a policy into its parts.

    Args:
        policy: a backbone around a network of this library, and the modules after it.
        env: the environment in which it acts.

    Raises:
        ValueError: if it is not such a policy, or has unknown inputs.
    """
    backbone, *modules = modules_in_order(policy)
    if not isinstance(backbone, Backbone):
        raise ValueError(
            f"the policy begins with {type(backbone).__name__}, but only one that begins with a "
            "torchrl_tit Backbone, as TensorDictSequential(backbone, actor) does, can be exported"
        )
    trunks = list(trunks_of(backbone.module).values())
    if not trunks:
        raise ValueError(
            f"the backbone is around a {type(backbone.module).__name__}; only one around a "
            "HistoryNetwork or TwoTrunks can be exported"
        )
    head = ActionHead(modules)
    known = zip(backbone.features_keys, trunks, strict=True)
    read = [(key, trunk) for key, trunk in known if unravel_key(key) in head.reads]
    if len(read) != 1:
        raise ValueError(
            f"the action depends on {len(read)} of the features {backbone.features_keys}; expected "
            "that it depends on one"
        )
    ((features_key, trunk),) = read
    names = list(trunk.observations)
    histories = backbone.history_keys[: len(names)]
    suffixes = [f"_{name}" for name in identifiers(names)] if len(names) > 1 else [""]
    observed = [trace_observation(env, *x) for x in zip(histories, suffixes, strict=True)]
    windows = {unravel_key(key) for key in backbone.history_keys}
    further = sorted(
        (key for key in head.reads - windows - {unravel_key(features_key)}), key=_last_name
    )
    for key in further:
        if key not in env.observation_spec.keys(True, True):
            raise ValueError(f"the policy reads {key!r}, which the environment does not write")
    keys = dict(zip(identifiers([_last_name(key) for key in further]), further, strict=True))
    specs = {name: env.observation_spec[key] for name, key in keys.items()}
    for transform in transforms_of(env):
        if "action" in transform.in_keys_inv:
            kind = type(transform).__name__
            raise ValueError(
                f"the environment changes actions by {kind}, which a file cannot hold: train with "
                "a gymnasium.Wrapper instead, or write the actions in the policy itself"
            )
    writer = getattr(env.base_env, "action_writer", None)
    action = env.action_spec_unbatched
    sequences = [t for t in transforms_of(env) if isinstance(t, SequenceHistory)]
    return Parts(
        backbone=backbone,
        trunk=trunk,
        features_key=features_key,
        head=head,
        observed=observed,
        further=keys,
        entries={
            name: Entry(tuple(spec.shape[env.ndim :]), spec.dtype) for name, spec in specs.items()
        },
        to_task=writer or nn.Identity(),
        action=Entry(tuple(action.shape), action.dtype),
        sequence=sequences[0] if sequences else None,
    )


def _last_name(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[-1]
