"""Sequences of consecutive steps: how they are read in TorchRL's recurrent mode, and arranged."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.modules import recurrent_mode

from torchrl_tit.histories.encoder import State
from torchrl_tit.modules.frame_tables import (
    FrameTable,
    find_starts,
    table_of_first,
    table_of_stored,
    table_without_histories,
)
from torchrl_tit.modules.torch_internals import is_mapped, is_transformed
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.settings.choices import Padding
from torchrl_tit.windows import differs


@dataclass(frozen=True)
class SequenceKeys:
    """The keys that a backbone reads from sequences.

    Raises:
        ValueError: if the numbers of observations and histories differ.
    """

    histories: list[NestedKey]
    """Keys of the histories."""
    observations: list[NestedKey]
    """Keys of the observations, one for each history."""
    padding: Padding | None
    """Padding before an episode; None to read the stored histories instead."""

    def __post_init__(self) -> None:
        if len(self.observations) != len(self.histories):
            raise ValueError(
                f"there are histories under {self.histories}, but observation_keys is "
                f"{self.observations}: name one for each"
            )

    def in_sequence(self, tensordict: TensorDictBase) -> bool:
        """Whether the last batch dimension of a tensordict is time."""
        if not recurrent_mode():
            return False
        entries = tensordict.keys(True)
        return "is_init" in entries or self.histories[0] not in entries

    def shape_of(self, tensordict: TensorDictBase) -> torch.Size:
        """The shape [*B, T] of sequences; that of "is_init" if they have no batch dimensions.

        TensorDict's ``dispatch`` gives none to the entries of a call by keyword.
        """
        return tensordict.batch_size or tensordict.get("is_init").shape[:-1]

    def group_of(self, tensordict: TensorDictBase, trunks: Sequence[HistoryNetwork]) -> torch.Size:
        """The shape between [*B, T] and an observation's own, such as [agents]; mostly empty."""
        if not trunks or (entry := tensordict.get(self.observations[0], None)) is None:
            return torch.Size()
        own = len(next(iter(trunks[0].observations.values())).shape)
        return entry.shape[len(self.shape_of(tensordict)) : entry.ndim - own]

    def lay_out(self, tensordict: TensorDictBase, trunks: Sequence[HistoryNetwork]) -> FrameTable:
        """Lays the frames of sequences [*B, T] out in a table.

        Args:
            tensordict: the sequences.
            trunks: the networks that read them; empty for other modules.

        Returns:
            The table, with windows [N, T, K]. N counts B, and the agents of each, if there are
            several.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if there is no time dimension, an entry does not fit a network, the next
                observation of a step is not that of the step after it, an observation is not the
                newest frame of its history, or padding makes other histories than the stored ones.
        """
        self._check(tensordict, trunks)
        *batch, steps = self.shape_of(tensordict)
        group = self.group_of(tensordict, trunks)
        count, time = math.prod([*batch, *group]), len(batch)

        def flat(entry: Tensor) -> Tensor:
            entry = entry.movedim(time, time + len(group))  # [*B, *group, T, ...]
            return entry.reshape(count, steps, *entry.shape[time + len(group) + 1 :])

        def flags(entry: Tensor) -> Tensor:
            flags = entry.reshape(math.prod(batch), steps, -1).any(-1)
            return flags.repeat_interleave(math.prod(group), 0) if group else flags

        observations = [flat(tensordict.get(key)) for key in self.observations]
        is_init = flags(tensordict.get("is_init"))
        ends = [tensordict.get(key, None) for key in ("done", ("next", "done"))]
        starts = find_starts(is_init, [flags(end) for end in ends if end is not None])
        if (mask := tensordict.get(("collector", "mask"), None)) is not None:
            starts = starts | ~flags(mask)  # a collector's split_trajs fills up with zeros
        following = [tensordict.get(unravel_key(("next", key)), None) for key in self.observations]
        for now, after in zip(observations, following, strict=True):
            if after is not None:
                _check_consecutive(now, flat(after), starts)
        stored = [tensordict.get(key, None) for key in self.histories]
        pairs = zip(self.histories, self.observations, strict=True)
        for keys, now, history in zip(pairs, observations, stored, strict=True):
            if history is not None:
                hint = "name the observation that this stacks in observation_keys"
                _check_newest(keys, now, flat(history), hint)
        histories = [history for history in stored if history is not None]
        if histories and self.padding is not None:
            own = time + len(group) + 1
            first = [x.select(time, 0).reshape(count, *x.shape[own:]) for x in histories]
            table = table_of_first(first, observations, is_init, self.padding)
            _check_padding(table, [flat(x) for x in histories])
            return table
        if histories:
            if is_mapped(starts):
                raise ValueError(
                    "vmap cannot map over sequences whose histories all count: use "
                    "deactivate_vmap=True, or a backbone with padding"
                )
            return table_of_stored([flat(x) for x in histories], observations, starts)
        padding, num_frames = self.padding or "same", trunks[0].num_frames
        return table_without_histories(observations, is_init, starts, num_frames, padding)

    def _check(self, tensordict: TensorDictBase, trunks: Sequence[HistoryNetwork]) -> None:
        entries = tensordict.keys(True)
        named = ", ".join(sorted(map(str, entries)))
        for key in (*self.observations, "is_init"):
            if key not in entries:
                hint = "name the keys of the observations in observation_keys"
                if key == "is_init":
                    hint = "add TorchRL's InitTracker to the environment"
                raise KeyError(
                    f"in recurrent mode a backbone reads sequences, which have no {key!r} here, "
                    f"only {named}: {hint}"
                )
        present = [key for key in self.histories if key in entries]
        if len(present) < len(self.histories) and (present or not trunks):
            raise KeyError(f"of the histories {self.histories}, some are missing: found {named}")
        if not (shape := self.shape_of(tensordict)):
            raise ValueError(
                "in recurrent mode the last batch dimension is time, but this tensordict has none: "
                "read a single step within set_recurrent_mode(False)"
            )
        for trunk in trunks:
            observations = (tensordict.get(key) for key in self.observations)
            leading = len(shape) + len(self.group_of(tensordict, trunks))
            trunk.check_frames(*(x.flatten(0, leading - 1) for x in observations))
            if present:
                trunk.check(*(tensordict.get(key) for key in present))


def step_episodes(
    step: Callable[[Sequence[Tensor], State, Tensor], tuple[Tensor, State]],
    histories: Sequence[Tensor],
    state: State,
    is_init: Tensor,
) -> tuple[Tensor, State]:
    """Reads steps, or in recurrent mode sequences, of a network that carries a state.

    As an `LSTMModule` does, a sequence starts from the stored state wherever ``is_init`` is True.
    It is not always zero: a `SliceSampler` marks where slices begin, and `GAE` marks next steps
    like the steps before them. A network starts an episode from zeros, so it is told here that none
    begins. Within ``torch.compile``, every stored state counts as zero. Where ``vmap`` maps over
    the data, each step is read on its own, which is slow.

    Args:
        step: :meth:`HistoryNetwork.step`.
        histories: [*B, 1, *observation_shape] each; the last dimension of B is time.
        state: the state before each step, [*B, ...] each.
        is_init: bool [*B, 1].

    Returns:
        What ``step`` returns: features, float [*B, F], and the state after each step, of which only
        the last one of a sequence is right.
    """
    begins = is_init.squeeze(-1)
    mapped = any(map(is_mapped, [begins, *state.values()]))
    values_count = recurrent_mode() and not (torch.compiler.is_compiling() or begins.is_meta)
    if not (values_count and (mapped or any(x[begins].any() for x in state.values()))):
        return step(histories, state, is_init)
    time, outputs = begins.ndim - 1, []

    def repeat(state: State, length: int) -> State:
        return {
            key: x.unsqueeze(time).expand(*x.shape[:time], length, *x.shape[time:])
            for key, x in state.items()
        }

    length = begins.shape[-1]
    marked = torch.arange(length) if mapped else begins.reshape(-1, length).any(0).nonzero()
    cuts = sorted({0, *marked.flatten().tolist()})
    now = {key: x.select(time, 0) for key, x in state.items()}
    for first, end in pairwise([*cuts, length]):
        stored = {key: x.select(time, first) for key, x in state.items()}
        begin = begins.select(time, first)
        now = {
            key: torch.where(expand_as_right(begin, x), stored[key], x) for key, x in now.items()
        }
        part = [x.narrow(time, first, end - first) for x in histories]
        none = torch.zeros_like(is_init.narrow(time, first, end - first))
        output, after = step(part, repeat(now, end - first), none)
        outputs.append(output)
        now = {key: x.select(time, -1) for key, x in after.items()}
    return torch.cat(outputs, time), repeat(now, length)


def as_sequences(samples: TensorDictBase, burn_in: int = 0) -> TensorDictBase:
    """Arranges slices of a replay buffer for networks that carry a state.

    The features of a step and of the true next observation need all observations before them, each
    once. So a sequence has the observation of each step in order and, where an episode ends, its
    last one, which is that of no step. A :class:`Backbone` that finds "sequence" in a tensordict
    reads it from a state of zeros, with whichever weights it has at that time, and gathers the
    features at "position". So actors, critics and their targets each have a state of their own,
    which TorchRL's `BurnInTransform` cannot give them: it writes one.

    ==========================  ============  ==================================================
    key                         batch         what it is
    ==========================  ============  ==================================================
    ``("sequence", "steps")``   [N, T, S]     "observation" and "is_init" of the sequence; zeros
                                              after its end. The same for all T, in memory once
    ``("sequence", "burn_in")`` [N, T, B]     those of the steps before it, if there are any:
                                              they only lead to its first state, without gradient
    ``("sequence", "position")`` [N, T]       int64 [N, T, 1], where in S a step is
    ==========================  ============  ==================================================

    Args:
        samples: slices of B + T consecutive steps, [N, B + T], with "is_init"; of a
            :class:`~torchrl_tit.datasets.HistoryStorage`, for example.
        burn_in: number B of steps.

    Returns:
        The last T steps, [N, T], with "sequence", also under "next".

    Raises:
        ValueError: if these are no slices of more than B steps, the next observation of a step is
            not that of the step after it, or "observation" is not the newest frame of "history".

    Example:
        >>> from torchrl_tit.datasets import ConsecutiveSampler, OnlineHistoryStorage
        >>> from torchrl.data import ReplayBuffer
        >>> from torchrl.envs import GymEnv
        >>> buffer = ReplayBuffer(
        ...     storage=OnlineHistoryStorage(1000, is_init=True),
        ...     sampler=ConsecutiveSampler(30),
        ...     batch_size=120,
        ...     transform=lambda samples: as_sequences(samples, burn_in=10),
        ... )
        >>> _ = buffer.extend(GymEnv("CartPole-v1").rollout(100, break_when_any_done=False))
        >>> buffer.sample().shape
        torch.Size([4, 20])
    """
    if samples.ndim != 2 or not 0 <= burn_in < samples.shape[1]:
        raise ValueError(
            f"samples must be slices [N, burn_in + T], but they are {list(samples.shape)} and "
            f"burn_in is {burn_in}: draw longer slices, or reshape flat ones"
        )
    seen = samples.select("observation", "is_init")
    after = samples["next"].select("observation")
    begins = samples["is_init"].reshape(samples.shape)
    for key, now in seen.exclude("is_init").items(True, True):
        _check_consecutive(now, after[key], begins)
        history_key = "history" if isinstance(key, str) else ("history", *key[1:])
        if (history := samples.get(history_key, None)) is not None:
            hint = "let the environment write what History stacks under this key"
            _check_newest((history_key, key), now, history, hint)
    before, (seen, after, begins) = (
        seen[:, :burn_in],
        (x[:, burn_in:] for x in (seen, after, begins)),
    )
    count, length = begins.shape
    within = begins.clone()
    within[:, 0] = False
    position = torch.arange(length, device=begins.device) + within.cumsum(1)
    row = torch.arange(count, device=begins.device).unsqueeze(1)
    steps = seen.new_zeros(count, int(position.max()) + 2)
    steps[row, position + 1] = after.set("is_init", torch.zeros_like(seen["is_init"]))
    steps[row, position] = seen
    parts = {"steps": steps, "burn_in": before} if burn_in else {"steps": steps}
    shared = {
        name: part.unsqueeze(1).expand(count, length, part.shape[1]) for name, part in parts.items()
    }
    arranged = samples[:, burn_in:].copy()
    for group, shift in ((arranged, 0), (arranged["next"], 1)):
        group["sequence"] = TensorDict(
            {**shared, "position": (position + shift).unsqueeze(-1)}, [count, length]
        )
    return arranged


def _check_consecutive(observation: Tensor, following: Tensor, starts: Tensor) -> None:
    """Raises ValueError if steps [N, T] do not follow one another, as shuffled ones do not."""
    if is_transformed() or observation.is_meta:
        return
    if (differs(observation[:, 1:], following[:, :-1]) & ~starts[:, 1:]).any():
        raise ValueError(
            "in recurrent mode the last batch dimension is time, but the next observation of a "
            "step is not the observation of the step after it: leave is_init out of shuffled steps "
            "and those of MultiStep (or read them within set_recurrent_mode(False)), and set it "
            'where a sequence begins; the mask of padded steps is ("collector", "mask")'
        )


def _check_newest(
    keys: tuple[NestedKey, NestedKey], observation: Tensor, history: Tensor, hint: str
) -> None:
    """Raises ValueError if an observation [N, T, ...] is not the newest frame of its history.

    Of a history that is expanded over time, only the first step counts.
    """
    if is_transformed() or observation.is_meta:
        return
    if history.ndim == observation.ndim + 1:
        steps = slice(None if history.stride(1) else 1)
        if not differs(observation[:, steps], history[:, steps, -1]).any():
            return
    raise ValueError(
        f"in recurrent mode sequences are read from {keys[1]!r}, but it is not the newest frame of "
        f"{keys[0]!r}: {hint}"
    )


def _check_padding(table: FrameTable, histories: Sequence[Tensor]) -> None:
    """Raises ValueError if the windows of a table are not the histories, [N, T, K, ...] each.

    The frame before the newest one tells, unless the first history is expanded over time.
    """
    if is_transformed() or histories[0].is_meta:
        return
    newest = table.windows.newest(2)
    for frames, history in zip(table.frames, histories, strict=True):
        before = slice(-2, -1)
        if not history.stride(1):
            continue
        if differs(newest.gather(frames)[:, :, before], history[:, :, before]).any():
            raise ValueError(
                "with padding, only the first history of a sequence is read, but the stored "
                "histories are others than those that follow from it: leave padding out for flat "
                "slices, for the next steps of a loss or GAE, and if History pads otherwise"
            )


def default_observation_keys(histories: Sequence[NestedKey]) -> list[NestedKey]:
    """Names the observations of histories: their keys, with "history" replaced by "observation".

    Example:
        >>> default_observation_keys(["history", ("history", "image"), ("agents", "history")])
        ['observation', ('observation', 'image'), ('agents', 'observation')]
    """
    return [
        key.replace("history", "observation")
        if isinstance(key, str)
        else ("observation", *key[1:])
        if key[0] == "history"  # of several observations
        else (*key[:-1], key[-1].replace("history", "observation"))
        for key in histories
    ]


def beside(key: NestedKey, name: str) -> NestedKey:
    """Names another entry of the same group.

    Example:
        >>> beside("features", "action"), beside(("agents", "features"), "action")
        ('action', ('agents', 'action'))
    """
    return name if isinstance(key, str) else unravel_key((*key[:-1], name))
