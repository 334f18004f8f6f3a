"""Flows of information in a network, measured with gradients."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import torch
from torch import Tensor, nn

from torchrl_tit.analysis.layers import inner_of
from torchrl_tit.frames.encoder import FrameEncoder
from torchrl_tit.frames.inner import InnerTransformer
from torchrl_tit.histories.catformer import Catformer
from torchrl_tit.histories.coberl import CoBERL
from torchrl_tit.histories.decision_transformer import DecisionTransformer
from torchrl_tit.histories.encoder import HistoryEncoder, RecurrentEncoder
from torchrl_tit.histories.mlp import D2RL, MLP, OFENet
from torchrl_tit.layers.block import TransformerBlock
from torchrl_tit.networks import HistoryNetwork

Kind: TypeAlias = Literal["spatial", "temporal"]
Unit: TypeAlias = tuple[Kind, int, int]
"""A unit: its kind, its number, and the number of its frame, if it has one."""


@dataclass(frozen=True)
class MeasuredFlows:
    """Numbers of flows of information in a network, measured with gradients."""

    spatial: int
    """Blocks on a frame whose output depends on other patches than its own."""
    temporal: int
    """Blocks over the frames whose newest output depends on earlier steps."""
    spatial_to_spatial: int
    """S-S: blocks on frames that read a block on a frame."""
    temporal_to_temporal: int
    """T-T: blocks over the frames that read another one."""
    temporal_to_output: int
    """Blocks over the frames that the history encoder's output reads: more than one is a dense
    connection, which the paper's table counts as T-T."""
    spatial_to_temporal: int
    """S-T: blocks over the frames that read a frame's encoder."""
    temporal_to_spatial: int
    """T-S: blocks on frames that read a block over the frames."""


def measure_flows(network: HistoryNetwork) -> MeasuredFlows:
    """Measures with gradients which parts of a network read which others.

    The output of each block is detached from its inputs. What the gradient of another block's
    output then reaches is read directly, not through a third block. Units are those of
    :func:`~torchrl_tit.analysis.count_flows`, so the two can be compared. Only Enhanced_TIT's T-T
    differs in kind: its outer blocks do not read each other, and the output reads all of them.

    Args:
        network: a network, which is left unchanged. Its inputs, and the directions in which its
            outputs are differentiated, are drawn at random.

    Raises:
        ValueError: if the parts of the history encoder are unknown.

    Example:
        >>> from torchrl_tit import EnhancedTIT, VanillaTIT
        >>> flows = measure_flows(EnhancedTIT((4,), num_frames=3, num_blocks=2))
        >>> flows.temporal_to_temporal, flows.temporal_to_output, flows.temporal_to_spatial
        (0, 2, 0)
        >>> flows = measure_flows(VanillaTIT((4,), num_frames=3, num_blocks=2))
        >>> flows.temporal_to_temporal, flows.temporal_to_output, flows.temporal_to_spatial
        (1, 1, 0)
    """
    with torch.random.fork_rng(devices=[]), torch.enable_grad():
        torch.manual_seed(0)
        network = deepcopy(network).double().cpu().eval().requires_grad_(True)
        calls = _watch(network)
        inputs = _draw_inputs(network)
        tokens = network.as_floats(network.encode_frames(*inputs[: len(network.frames)]))
        output = network.history_encoder(tokens, *inputs[len(network.frames) :])
        return _count(calls, output)


@dataclass(frozen=True)
class _Group:
    """Modules that are called in sequence; each call is a unit on each frame or over all frames."""

    kind: Kind
    modules: list[nn.Module]
    frames_dim: int | None = None
    """Dimension of the output over frames, each of which is a unit; None for a single unit."""
    per_unit: int = 1
    """Number of modules, called in sequence, that form one unit."""


@dataclass(frozen=True)
class _Call:
    """A call of one of these modules."""

    group: _Group
    number: int
    """Index of the unit among those of its kind."""
    x: Tensor
    """Its input, [N, positions, ...]."""
    raw: Tensor
    """Its output."""
    leaf: Tensor
    """The output detached from its inputs, which others read."""

    def units(self, values: Tensor) -> Iterator[tuple[Unit, Tensor]]:
        """Its units, and their parts of its output or of the output's gradient."""
        dim = self.group.frames_dim
        parts = [values] if dim is None else values.unbind(dim)
        for frame, part in enumerate(parts):
            yield (self.group.kind, self.number, frame), part

    def mixing(self) -> Iterator[Unit]:
        """The units whose newest or class token depends on other positions."""
        for unit, part in self.units(self.raw):
            if self.group.kind == "temporal":
                newest = part[:, -1] if part.ndim == 3 else part
                slope = _slopes(newest, [self.x])[0]
                others = None if slope is None else slope[:, :-1]
            else:
                slope = _slopes(part[..., 0, :], [self.x])[0]
                others = None if slope is None else slope[:, 1:]
            if others is not None and others.any():
                yield unit


def _watch(network: HistoryNetwork) -> list[_Call]:
    """Makes a network's blocks record their calls in the returned list."""
    calls: list[_Call] = []
    numbers: dict[Kind, int] = {"spatial": 0, "temporal": 0}
    frames = [] if network.history_encoder.reads_frames else network.frames
    for group in [*map(_frame_group, frames), *_history_groups(network.history_encoder)]:
        start, count = numbers[group.kind], itertools.count()

        def record(
            module: nn.Module,
            inputs: Any,
            output: Any,
            group: _Group = group,
            start: int = start,
            count: Iterator[int] = count,
        ) -> Any:
            raw, *rest = output if isinstance(output, tuple) else (output,)
            leaf = raw.detach().requires_grad_()
            number = start + next(count) // group.per_unit
            calls.append(_Call(group, number, inputs[0], raw, leaf))
            return (leaf, *rest) if rest else leaf

        for module in dict.fromkeys(group.modules):
            module.register_forward_pre_hook(_require_gradient)
            module.register_forward_hook(record)
        numbers[group.kind] += len(group.modules) // group.per_unit
    return calls


def _frame_group(encoder: FrameEncoder) -> _Group:
    """The spatial units of a frame encoder."""
    inner = inner_of(encoder)
    if inner is None:
        return _Group("spatial", [encoder], frames_dim=1)
    return _Group("spatial", _blocks(inner), frames_dim=0)


def _history_groups(encoder: HistoryEncoder) -> list[_Group]:
    """The units of a history encoder."""
    inner = inner_of(encoder)
    if inner is not None:  # it sees all frames as one image
        return [_Group("spatial", _blocks(inner))]
    if isinstance(encoder, Catformer):
        pairs = zip(encoder.attentions, encoder.ffns, strict=True)
        return [_Group("temporal", [layer for pair in pairs for layer in pair], per_unit=2)]
    if isinstance(encoder, RecurrentEncoder):
        return [_Group("temporal", [encoder])]
    if encoder.reads_frames or isinstance(encoder, MLP | OFENet | D2RL):
        return []
    blocks = getattr(encoder, "blocks", None)
    if not isinstance(blocks, nn.ModuleList):
        raise ValueError(
            f"{type(encoder).__name__} has no blocks that are known here, so what depends on what "
            "cannot be told apart: name its blocks `blocks`, a ModuleList"
        )
    number = getattr(encoder, "num_blocks", len(blocks))  # they can share their weights
    groups = [_Group("temporal", [blocks[i % len(blocks)] for i in range(number)])]
    if isinstance(encoder, CoBERL):
        groups.append(_Group("temporal", [encoder.gate, encoder.lstm], per_unit=2))
    return groups


def _blocks(inner: InnerTransformer) -> list[nn.Module]:
    """The blocks of an inner transformer, each repeated as often as it is called."""
    blocks = [inner.blocks[i % len(inner.blocks)] for i in range(inner.num_blocks)]
    if inner.num_blocks == 1:  # a shortcut that hooks do not see
        (block,) = blocks
        assert isinstance(block, TransformerBlock)

        def read_first(first: Tensor, rest: Tensor) -> Tensor:
            return block(torch.cat([first.expand(len(rest), -1, -1), rest], 1), read="first")

        block.read_first = read_first  # type: ignore[method-assign]
    return blocks


def _require_gradient(module: nn.Module, inputs: tuple[Any, ...]) -> tuple[Any, ...]:
    x, *rest = inputs
    if x.is_floating_point() and not x.requires_grad:
        x = x.detach().requires_grad_()
    return (x, *rest)


def _draw_inputs(network: HistoryNetwork) -> list[Tensor]:
    """A random history of each observation, [1, K, *observation], and the further inputs."""
    inputs = []
    frames = network.num_frames
    for seen in network.observations.values():
        if seen.categories is not None:
            columns = [torch.randint(n, (1, frames, 1)) for n in seen.categories]
            inputs.append(torch.cat(columns, -1))
        else:
            inputs.append(torch.randn(1, frames, *seen.shape, dtype=torch.float64))
    encoder = network.history_encoder
    if isinstance(encoder, DecisionTransformer):
        inputs.append(torch.randn(1, frames, encoder.action_dim, dtype=torch.float64))
        inputs.append(torch.randn(1, frames, 1, dtype=torch.float64))
        inputs.append(torch.arange(frames).unsqueeze(0))
    return inputs


def _count(calls: list[_Call], output: Tensor) -> MeasuredFlows:
    """Counts the flows between units."""
    edges: set[tuple[Unit, Unit]] = set()
    mixing: set[Unit] = set()
    for index, call in enumerate(calls):
        if _mixes(call.group):
            mixing.update(call.mixing())
        for unit, part in call.units(call.raw):
            edges.update((other, unit) for other in _read_by(part, calls[:index]) if other != unit)
    vertical = Counter((a[0], b[0]) for a, b in edges)
    horizontal = Counter(unit[0] for unit in mixing)
    to_output = [unit for unit in _read_by(output, calls) if unit[0] == "temporal"]
    return MeasuredFlows(
        spatial=horizontal["spatial"],
        temporal=horizontal["temporal"],
        spatial_to_spatial=vertical["spatial", "spatial"],
        temporal_to_temporal=vertical["temporal", "temporal"],
        temporal_to_output=len(set(to_output)),
        spatial_to_temporal=vertical["spatial", "temporal"],
        temporal_to_spatial=vertical["temporal", "spatial"],
    )


def _mixes(group: _Group) -> bool:
    """Whether blocks have attention or recurrence, which encoders of whole frames lack."""
    return not (group.kind == "spatial" and isinstance(group.modules[0], FrameEncoder))


def _read_by(part: Tensor, calls: list[_Call]) -> Iterator[Unit]:
    """The units of earlier calls that a part of an output depends on."""
    slopes = _slopes(part, [call.leaf for call in calls])
    for call, slope in zip(calls, slopes, strict=True):
        if slope is not None:
            yield from (unit for unit, own in call.units(slope) if own.any())


def _slopes(part: Tensor, inputs: list[Tensor]) -> list[Tensor | None]:
    """The gradients of an output in a random direction; None where it does not depend on it."""
    if not inputs or not part.requires_grad:
        return [None] * len(inputs)
    value = (part * torch.randn_like(part)).sum()
    return list(torch.autograd.grad(value, inputs, retain_graph=True, allow_unused=True))
