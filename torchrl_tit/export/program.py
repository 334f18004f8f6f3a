"""Policies as functions of plain tensors, which `torch.export` can trace."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.utils import expand_right, unravel_key
from torch import Tensor, nn

from torchrl_tit.export.parts import Entry, Parts
from torchrl_tit.histories.encoder import RecurrentEncoder
from torchrl_tit.settings.choices import Padding

FIRST = "is_init"
"""Name of the input that marks the beginning of an episode, bool [N]."""
NOISE = "noise"
"""Name of the input from which actions are sampled."""


def make_program(parts: Parts, *, step_by_step: bool = False, sample: bool = False) -> Program:
    """Turns a policy into a function of plain tensors.

    Args:
        parts: the policy.
        step_by_step: whether each frame is encoded only once.
        sample: whether actions are sampled.

    Raises:
        ValueError: if its history encoder has unknown inputs, or there is nothing to sample.
    """
    trunk = parts.trunk
    program: Program
    if trunk.history_encoder.context:
        if parts.sequence is None or len(parts.observed) != 1:
            raise ValueError(
                f"{type(trunk.history_encoder).__name__} reads "
                f"{', '.join(trunk.history_encoder.context)} beside observations, which only a "
                "Decision Transformer on a SequenceHistory can be exported with"
            )
        kind = SequenceSteps if step_by_step and trunk.num_frames > 1 else SequenceWindows
        program = kind(parts, sample=sample)
    elif trunk.carries_state:
        program = RecurrentSteps(parts, sample=sample)
    elif step_by_step and trunk.num_frames > 1:
        program = TokenSteps(parts, sample=sample)
    else:
        program = WindowProgram(parts, sample=sample)
    return program.complete().eval()


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
        self.num_frames = parts.trunk.num_frames
        """Number K of steps that it reads, which of a Decision Transformer may be fewer."""
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

    def forward(self, inputs: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Maps inputs to outputs, [N, ...] each."""
        parts = self.parts
        features, carried = self.read(inputs)
        further = {key: inputs[name] for name, key in parts.further.items()}
        entries = {parts.features_key: features, **further}
        if self.trunk.history_encoder.context:
            # The head of a Decision Transformer checks the kind of its actions.
            entries[unravel_key(parts.backbone.history_keys[1])] = inputs["actions"]
        action, parameters = self.head(entries, inputs.get(NOISE))
        carried = self.act(carried, action)
        following = {f"next_{name}": carried[name] for name in self.state}
        return {"action": self.to_task(action), **parameters, **following}

    def complete(self) -> Program:
        """Adds the inputs that all programs share; returns itself."""
        self.inputs |= self.parts.entries
        if self.noise is not None:
            with torch.no_grad():
                outputs = self(self.examples(1))
            parameter = outputs["logits" if "logits" in outputs else "loc"]
            self.inputs[NOISE] = Entry(tuple(parameter.shape[1:]), torch.float32)
        return self

    def examples(self, size: int) -> dict[str, Tensor]:
        """Returns inputs of zeros, with all actions allowed, [size, ...] each."""
        zeros = {name: entry.zeros(size) for name, entry in self.inputs.items()}
        masks = {name: torch.ones_like(zeros[name]) for name in self.parts.further}
        return {**zeros, **masks}


class WindowProgram(Program):
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
        self.names = [noun + seen.suffix for seen in parts.observed]
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
        self.names = [f"observation{seen.suffix}" for seen in parts.observed]
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


class SequenceWindows(Program):
    """Reads the last K observations, actions, returns to go and time steps.

        observation [N, K, *obs], actions [N, K, *action], return_to_go [N, K, 1],
        timestep int64 [N, K], mask bool [N, K]  ->  action

    Returns are unscaled, and steps before an episode are masked. As in
    :class:`~torchrl_tit.transforms.SequenceHistory`, the last action is not read.

    Args:
        parts: the policy.
        sample: whether actions are sampled.
    """

    def __init__(self, parts: Parts, *, sample: bool = False) -> None:
        super().__init__(parts, sample=sample)
        assert parts.sequence is not None
        (seen,), steps = parts.observed, parts.sequence.num_frames
        self.num_frames = steps
        self.return_scale = parts.sequence.return_scale
        self.inputs |= {
            "observation": Entry((steps, *seen.entry.shape), seen.entry.dtype),
            "actions": Entry((steps, *parts.action.shape), parts.action.dtype),
            "return_to_go": Entry((steps, 1), torch.float32),
            "timestep": Entry((steps,), torch.int64),
            "mask": Entry((steps,), torch.bool),
        }

    def read(self, inputs: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """See :meth:`Program.read`; no state is carried on."""
        (prepare,) = self.preparations
        features = self.trunk(
            prepare(inputs["observation"]),
            inputs["actions"],
            inputs["return_to_go"] / self.return_scale,
            inputs["timestep"],
            inputs["mask"],
        )
        return features, {}

    def feed(self, episode: Sequence[Step]) -> dict[str, Tensor]:
        """See :meth:`Program.feed`."""
        size = len(episode[-1].observations[0])
        *before, last = (step.tensordict["action"] for step in episode)
        times = [torch.full((size,), time) for time in range(len(episode))]
        to_go = [step.tensordict["target_return"] for step in episode]
        entries = {
            "observation": [step.observations[0] for step in episode],
            "actions": [*before, torch.zeros_like(last)],
            "return_to_go": to_go,
            "timestep": times,
            "mask": [torch.ones_like(time, dtype=torch.bool) for time in times],
        }
        return {name: stack(x, self.num_frames, "constant") for name, x in entries.items()}


class SequenceSteps(TokenSteps):
    """Carries the tokens of the last K - 1 frames, their actions and returns, and the time.

        observation [N, *obs], is_init [N], reward [N], target_return [N], state  ->  action, next_

    The return to go is the target, read at the episode's first step, minus the rewards since then.

    Args:
        parts: the policy.
        sample: whether actions are sampled.
    """

    def __init__(self, parts: Parts, *, sample: bool = False) -> None:
        super().__init__(parts, sample=sample)
        assert parts.sequence is not None
        steps = parts.sequence.num_frames
        self.num_frames = steps
        self.return_scale = parts.sequence.return_scale
        scalar = Entry((), torch.float32)
        self.inputs |= {"reward": scalar, "target_return": scalar}
        tokens = self.inputs["tokens"]
        self.carry(
            {
                "tokens": Entry((steps - 1, *tokens.shape[1:]), tokens.dtype),
                "actions": Entry((steps - 1, *parts.action.shape), parts.action.dtype),
                "returns": Entry((steps - 1, 1), torch.float32),
                "return_to_go": scalar,
                "time": Entry((), torch.int64),
            }
        )

    def read(self, inputs: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """See :meth:`Program.read`."""
        first, steps = inputs[FIRST], self.num_frames
        tokens = self.window(inputs)  # [N, K, L, D]
        time = torch.where(first, 0, inputs["time"] + 1)
        to_go = inputs["return_to_go"] - inputs["reward"]
        to_go = torch.where(first, inputs["target_return"], to_go)
        returns, actions = (
            torch.where(expand_right(first, x.shape), 0, x)
            for x in (inputs["returns"], inputs["actions"])
        )
        returns = torch.cat([returns, to_go.reshape(-1, 1, 1)], dim=1)
        actions = torch.cat([actions, torch.zeros_like(actions[:, :1])], dim=1)
        back = torch.arange(1 - steps, 1, device=time.device)
        timestep = time.unsqueeze(1) + back  # negative before the episode
        features = self.trunk.encode_history(
            tokens, actions, returns / self.return_scale, timestep.clamp(min=0), timestep >= 0
        )
        carried = {
            "tokens": tokens[:, 1:],
            "actions": actions[:, 1:],
            "returns": returns[:, 1:],
            "return_to_go": to_go,
            "time": time,
        }
        return features, carried

    def act(self, carried: dict[str, Tensor], action: Tensor) -> dict[str, Tensor]:
        """Adds the action to the actions that are carried on."""
        actions = torch.cat([carried["actions"][:, :-1], action.unsqueeze(1)], dim=1)
        return {**carried, "actions": actions}

    def feed(self, episode: Sequence[Step]) -> dict[str, Tensor]:
        """See :meth:`Program.feed`."""
        step = episode[-1]
        target = episode[0].tensordict["target_return"].squeeze(-1)
        return {**super().feed(episode), "reward": step.reward, "target_return": target}


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
