"""Policies as functions of plain tensors, which `torch.export` can trace."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.envs import EnvBase

from torchrl_tit.export.head import Head, split_policy
from torchrl_tit.export.observed import Entry, Observed, identifiers, trace, transforms_of
from torchrl_tit.export.task_action import TaskAction
from torchrl_tit.histories.encoder import RecurrentEncoder
from torchrl_tit.modules.backbone import Backbone, trunks_of
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.transforms import SequenceHistory
from torchrl_tit.windows import Padding

FIRST = "is_init"
"""Name of the input that marks the beginning of an episode, bool [N]."""
NOISE = "noise"
"""Name of the input from which actions are sampled."""


@dataclass(frozen=True)
class Parts:
    """The parts of a policy, and its inputs in an environment."""

    backbone: Backbone
    trunk: HistoryNetwork
    """The network of the action; a separate network of the value is left out."""
    features_key: NestedKey
    head: Head
    observed: Sequence[Observed]
    """The observations, in the order of the network."""
    further: Mapping[str, NestedKey]
    """Keys of the head's other inputs from the environment, such as masks, by name of the input."""
    entries: Mapping[str, Entry]
    """Shapes and dtypes of these."""
    to_task: nn.Module
    """Converts actions to those of the task."""
    action: Entry
    """An action of the policy."""
    sequence: SequenceHistory | None
    """The transform that writes the windows of a Decision Transformer."""

    @property
    def names(self) -> list[str]:
        """Suffixes of argument names for the observations: "" for a single one, or "_NAME"."""
        if len(self.observed) == 1:
            return [""]
        return [f"_{name}" for name in identifiers([seen.name for seen in self.observed])]


def read_parts(policy: nn.Module, env: EnvBase) -> Parts:
    """Splits a policy into its parts.

    Args:
        policy: a backbone around a network of this library, and the modules after it.
        env: the environment in which it acts.

    Raises:
        ValueError: if it is not such a policy, or has unknown inputs.
    """
    backbone, modules = split_policy(policy)
    trunks = list(trunks_of(backbone.module).values())
    if not trunks:
        raise ValueError(
            f"the backbone is around a {type(backbone.module).__name__}; only one around a "
            "HistoryNetwork or TwoTrunks can be exported"
        )
    head = Head(modules)
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
    observed = [trace(env, key, name) for key, name in zip(histories, names, strict=True)]
    windows = {unravel_key(key) for key in backbone.history_keys}
    further = sorted(
        (key for key in head.reads - windows - {unravel_key(features_key)}), key=_last_name
    )
    for key in further:
        if key not in env.observation_spec.keys(True, True):
            raise ValueError(f"the policy reads {key!r}, which the environment does not write")
    keys = dict(zip(identifiers([_last_name(key) for key in further]), further, strict=True))
    specs = {name: env.observation_spec[key] for name, key in keys.items()}
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
        to_task=nn.Identity() if writer is None else TaskAction(writer),
        action=Entry(tuple(action.shape), action.dtype),
        sequence=sequences[0] if sequences else None,
    )


@dataclass(frozen=True)
class Step:
    """The data of one step of an episode that a program may read."""

    observations: Sequence[Tensor]
    """The value of each observation, [N, *obs], before anything is hidden."""
    tensordict: TensorDictBase
    """The live policy's inputs and outputs, [N]."""
    reward: Tensor
    """The reward of the previous step, float [N]; zeros at an episode's first step."""


class Program(nn.Module, ABC):
    """A policy as a function from tensors by name to tensors by name.

    It writes "action", in the task's format, and the values from which the action was chosen:
    "logits", "loc" and "scale", or "action_value". State that is carried from step to step is read
    as NAME and written as "next_NAME".

    Args:
        parts: the policy.
        sample: whether actions are sampled, from an input "noise".

    Raises:
        ValueError: if there is no distribution to sample from.
    """

    def __init__(self, parts: Parts, *, sample: bool) -> None:
        super().__init__()
        if sample and parts.head.noise is None:
            raise ValueError(
                "this policy has no distribution to draw actions from, only one action for each "
                "observation: leave out --sample"
            )
        self.parts = parts
        self.trunk = parts.trunk
        self.head = parts.head
        self.to_task = parts.to_task
        self.preparations = nn.ModuleList(seen.layers for seen in parts.observed)
        self.noise = parts.head.noise if sample else None
        """The kind of "noise", by the name of NumPy's generator; None if actions are not
        sampled."""
        self.inputs: dict[str, Entry] = {}
        """The inputs by name."""
        self.state: list[str] = []
        """Names of the inputs that carry state from step to step."""

    @abstractmethod
    def read(self, inputs: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Returns the features, float [N, F], and the state to carry on, by name."""

    @abstractmethod
    def feed(self, episode: Sequence[Step]) -> dict[str, Tensor]:
        """Returns the inputs at the last step of an episode, except state, noise and masks.

        Args:
            episode: its steps so far.
        """

    def act(self, carried: dict[str, Tensor], action: Tensor) -> dict[str, Tensor]:
        """Returns the state to carry on, once the action is known; by default the same."""
        return carried

    def windows(self, inputs: Mapping[str, Tensor]) -> dict[NestedKey, Tensor]:
        """Returns the entries of the windows that the head reads, by key; by default none."""
        return {}

    def forward(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Maps inputs to outputs, [N, ...] each."""
        parts = self.parts
        features, carried = self.read(inputs)
        further = {key: inputs[name] for name, key in parts.further.items()}
        entries = {parts.features_key: features, **self.windows(inputs), **further}
        action, parameters = self.head(entries, inputs.get(NOISE))
        carried = self.act(carried, action)
        following = {f"next_{name}": carried[name] for name in self.state}
        return {"action": self.to_task(action), **parameters, **following}

    def complete(self) -> Program:
        """Adds the inputs that all programs share; returns itself."""
        self.inputs |= self.parts.entries
        if self.noise is not None:
            # A mask of zeros would allow no action; noise has the shape of the parameters.
            self.inputs[NOISE] = Entry(tuple(self._parameter().shape[1:]), torch.float32)
        return self

    def examples(self, size: int) -> dict[str, Tensor]:
        """Returns inputs of zeros, with all actions allowed, [size, ...] each."""
        zeros = {name: entry.zeros(size) for name, entry in self.inputs.items()}
        masks = {name: torch.ones_like(zeros[name]) for name in self.parts.further}
        return {**zeros, **masks}

    @torch.no_grad()
    def _parameter(self) -> Tensor:
        outputs = self(self.examples(1))
        return outputs["logits" if "logits" in outputs else "loc"]


class Windows(Program):
    """Reads the last K observations or, if K = 1, the observation itself.

        history [N, K, *obs]  ->  action

    Args:
        parts: the policy.
        sample: whether actions are sampled.
    """

    def __init__(self, parts: Parts, *, sample: bool = False) -> None:
        super().__init__(parts, sample=sample)
        num_frames = parts.trunk.num_frames
        self.stacks = num_frames > 1
        noun, leading = ("history", (num_frames,)) if self.stacks else ("observation", ())
        self.names = [noun + name for name in parts.names]
        for name, seen in zip(self.names, parts.observed, strict=True):
            self.inputs[name] = Entry((*leading, *seen.entry.shape), seen.entry.dtype)

    def read(self, inputs: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """See :meth:`Program.read`; no state is carried on."""
        frames = [inputs[name] if self.stacks else inputs[name].unsqueeze(1) for name in self.names]
        prepared = [prepare(x) for prepare, x in zip(self.preparations, frames, strict=True)]
        return self.trunk(*prepared), {}

    def feed(self, episode: Sequence[Step]) -> dict[str, Tensor]:
        """See :meth:`Program.feed`."""
        given = {}
        for index, (name, seen) in enumerate(zip(self.names, self.parts.observed, strict=True)):
            frames = [step.observations[index] for step in episode]
            if self.stacks:
                given[name] = stack(frames, self.trunk.num_frames, seen.padding)
            else:
                given[name] = frames[-1]
        return given


class Steps(Program):
    """Reads the newest observation, and state that it carries from step to step.

    Args:
        parts: the policy.
        sample: whether actions are sampled.
    """

    def __init__(self, parts: Parts, *, sample: bool = False) -> None:
        super().__init__(parts, sample=sample)
        self.names = [f"observation{name}" for name in parts.names]
        for name, seen in zip(self.names, parts.observed, strict=True):
            self.inputs[name] = seen.entry
        self.inputs[FIRST] = Entry((), torch.bool)

    def newest(self, inputs: Mapping[str, Tensor]) -> list[Tensor]:
        """Returns the newest observations as the network reads them, [N, 1, *obs] each."""
        frames = [inputs[name].unsqueeze(1) for name in self.names]
        return [prepare(x) for prepare, x in zip(self.preparations, frames, strict=True)]

    def feed(self, episode: Sequence[Step]) -> dict[str, Tensor]:
        """See :meth:`Program.feed`."""
        observations = episode[-1].observations
        given = dict(zip(self.names, observations, strict=True))
        given[FIRST] = torch.full((len(observations[0]),), len(episode) == 1)
        return given

    def carry(self, state: Mapping[str, Entry]) -> None:
        """Adds the state that is carried from step to step to the inputs."""
        self.inputs |= state
        self.state = list(state)


class TokenSteps(Steps):
    """Carries the tokens of the last K - 1 frames, so that each frame is encoded once.

        observation [N, *obs], is_init [N], tokens [N, K - 1, L, D]  ->  action, next_tokens

    Args:
        parts: the policy.
        sample: whether actions are sampled.
    """

    padding: Tensor | None

    def __init__(self, parts: Parts, *, sample: bool = False) -> None:
        super().__init__(parts, sample=sample)
        blank = [seen.entry.zeros(1).unsqueeze(1) for seen in parts.observed]
        with torch.no_grad():
            tokens = self.encode(
                [prepare(x) for prepare, x in zip(self.preparations, blank, strict=True)]
            )
        entry = Entry((parts.trunk.num_frames - 1, *tokens.shape[2:]), tokens.dtype)
        self.carry({"tokens": entry})
        zeros = "constant" in {seen.padding for seen in parts.observed}
        # Padding before an episode: the tokens of zeros, or those of its first observation.
        self.register_buffer("padding", tokens if zeros else None)

    def encode(self, frames: Sequence[Tensor]) -> Tensor:
        """Maps frames to tokens, [N, 1, *obs] each -> [N, 1, L, D]."""
        encoded = [encode(x) for encode, x in zip(self.trunk.frames, frames, strict=True)]
        return self.trunk.as_floats(self.trunk.join_tokens(encoded))

    def window(self, inputs: Mapping[str, Tensor]) -> Tensor:
        """Returns the tokens of the last K frames, [N, K, L, D]."""
        newest = self.encode(self.newest(inputs))
        first = newest if self.padding is None else self.padding
        kept = torch.where(inputs[FIRST].reshape(-1, 1, 1, 1), first, inputs["tokens"])
        return torch.cat([kept, newest], dim=1)

    def read(self, inputs: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """See :meth:`Program.read`."""
        tokens = self.window(inputs)
        return self.trunk.encode_history(tokens), {"tokens": tokens[:, 1:]}


class RecurrentSteps(Steps):
    """Carries the state of a recurrent network.

        observation [N, *obs], is_init [N], recurrent_state_h [N, 1, H], ...  ->  action, next_...

    Args:
        parts: the policy.
        sample: whether actions are sampled.
    """

    def __init__(self, parts: Parts, *, sample: bool = False) -> None:
        super().__init__(parts, sample=sample)
        encoder = parts.trunk.history_encoder
        assert isinstance(encoder, RecurrentEncoder)
        dtype = next(parts.trunk.parameters()).dtype
        self.carry(
            {name: Entry(tuple(shape), dtype) for name, shape in encoder.state_shapes.items()}
        )

    def read(self, inputs: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """See :meth:`Program.read`."""
        state = {name: inputs[name] for name in self.state}
        encoder = self.trunk.history_encoder
        assert isinstance(encoder, RecurrentEncoder)
        tokens = self.trunk.as_floats(self.trunk.encode_frames(*self.newest(inputs))).squeeze(1)
        outputs, state = encoder.single_step(tokens, state, inputs[FIRST].unsqueeze(-1))
        return self.trunk.head(outputs), state


def stack(frames: Sequence[Tensor], num_frames: int, padding: Padding | None) -> Tensor:
    """Stacks the last K of an episode's frames, [N, ...] each -> [N, K, ...].

    Args:
        frames: all frames of the episode so far.
        num_frames: number K.
        padding: padding before the first frame: that frame ("same"), or zeros.

    Example:
        >>> stack([torch.tensor([1]), torch.tensor([2])], 4, "same")
        tensor([[1, 1, 1, 2]])
    """
    last = list(frames[-num_frames:])
    first = last[0] if padding == "same" else torch.zeros_like(last[0])
    return torch.stack([first] * (num_frames - len(last)) + last, dim=1)


def _last_name(key: NestedKey) -> str:
    return key if isinstance(key, str) else key[-1]
