"""The paper's table of information flows, measured with gradients."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, TypeAlias

import torch
from torch import Tensor, nn

from torchrl_tit import settings
from torchrl_tit.analysis.layers import inner_of
from torchrl_tit.frames.inner import InnerTransformer
from torchrl_tit.histories.catformer import Catformer
from torchrl_tit.histories.coberl import CoBERL
from torchrl_tit.histories.decision_transformer import DecisionTransformer
from torchrl_tit.histories.encoder import HistoryEncoder, RecurrentEncoder
from torchrl_tit.networks import HistoryNetwork, build_network

Kind: TypeAlias = Literal["spatial", "temporal"]
Unit: TypeAlias = tuple[Kind, int, int]
"""A unit: its kind, its number, and the number of its frame, if it has one."""


@dataclass(frozen=True)
class Flows:
    """Numbers of flows of information in a network (arXiv 2212.14538, table of flows)."""

    spatial: int
    """Horizontal, within a frame: blocks on a frame whose class token reads other patches."""
    temporal: int
    """Horizontal, over frames: blocks over the frames whose newest output reads earlier frames."""
    spatial_to_spatial: int
    """Vertical, S-S: from a block on a frame to another one on this frame."""
    temporal_to_temporal: int
    """Vertical, T-T: from a block over the frames to another one, or to a dense connection."""
    spatial_to_temporal: int
    """Vertical, S-T: from a frame's encoder to a block over the frames."""
    temporal_to_spatial: int
    """Vertical, T-S: from a block over the frames to a frame's encoder."""
    temporal_to_output: int
    """Blocks over the frames that the history encoder's output reads. If it reads several, it is a
    dense connection, and these flows are among T-T."""


def count_flows(network: HistoryNetwork) -> Flows:
    """Counts the flows of information in a network, by gradients.

    - A *unit* is a block in one place: an inner block on one of the K frames is a spatial unit, a
      block over the frames is a temporal one. A frame encoder without attention is a single spatial
      unit per frame, with no spatial flow: convolutions are local, as the paper says of ResNet.
    - A *horizontal* flow goes through each unit that mixes the patches of a frame, or the frames.
    - A *vertical* flow goes from a unit to each unit that reads its output directly. The output of
      each unit is detached from its inputs, so what the gradient of another unit's output reaches
      is read directly. A dense connection, which concatenates the outputs of several temporal
      units, reads each of them: so Enhanced_TIT has L flows T-T, although none of its outer blocks
      reads another one.

    With L > 1 blocks and K > 1 frames, this gives the numbers that the paper prints for Vanilla_TIT
    and Enhanced_TIT: spatial LK and LK, temporal L and L, S-S (L - 1)K and (L - 1)K, T-T L - 1 and
    L, S-T K and LK, T-S 0 and 0. Networks that stack the frames as channels, or as entries, mix
    them without any flow of this kind.

    The blocks of a history encoder are those in its ``blocks``, in the order in which they are
    called.

    Source: arXiv 2212.14538, appendix "Discussion and Improvement".

    Args:
        network: a network, which is left unchanged. Its inputs, and the directions in which its
            outputs are differentiated, are drawn at random.

    Raises:
        ValueError: if an encoder over frames has no ``blocks``.

    Example:
        >>> from torchrl_tit import EnhancedTIT, VanillaTIT
        >>> flows = count_flows(EnhancedTIT((4,), num_frames=3, num_blocks=2))
        >>> flows.spatial, flows.temporal_to_temporal, flows.temporal_to_output
        (6, 2, 2)
        >>> flows = count_flows(VanillaTIT((4,), num_frames=3, num_blocks=2))
        >>> flows.spatial, flows.temporal_to_temporal, flows.temporal_to_output
        (6, 1, 1)
    """
    with torch.random.fork_rng(devices=[]), torch.enable_grad():
        torch.manual_seed(0)
        network = deepcopy(network).double().cpu().eval().requires_grad_(True)
        tape = _Tape(network)
        inputs = _draw_inputs(network)
        tokens = network.as_floats(network.encode_frames(*inputs[: len(network.frames)]))
        output = network.history_encoder(tokens, *inputs[len(network.frames) :])
        return tape.count(output)


def flow_table(networks: Mapping[str, settings.Network]) -> str:
    """Formats the flows of information of networks as a Markdown table.

    Args:
        networks: their settings by name. They are built for arrays of 4 entries, or for images of
            36 x 36 pixels if they do not read arrays.

    Raises:
        ValueError: see :func:`count_flows`.

    Example:
        >>> from torchrl_tit.settings.networks import vanilla_tit
        >>> print(flow_table({"Vanilla_TIT": vanilla_tit(4)}))
        | network | K | spatial | temporal | S-S | T-T | S-T | T-S | T-T: blocks, output |
        |---|---|---|---|---|---|---|---|---|
        | Vanilla_TIT | 4 | 8 | 2 | 4 | 1 | 4 | 0 | 1, 1 |
    """
    lines = [
        "| network | K | spatial | temporal | S-S | T-T | S-T | T-S | T-T: blocks, output |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, network in networks.items():
        flows = count_flows(_build(network))
        *numbers, output = (getattr(flows, field.name) for field in fields(Flows))
        between = flows.temporal_to_temporal - (output if output > 1 else 0)
        cells = [name, network.num_frames, *numbers, f"{between}, {output}"]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def _build(network: settings.Network) -> HistoryNetwork:
    """Builds a network; if it has two trunks, only one."""
    network = replace(network, trunks="shared")
    try:
        built = build_network(network, (4,), action_dim=1)
    except ValueError:
        built = build_network(network, (36, 36), action_dim=1)
    assert isinstance(built, HistoryNetwork)
    return built


@dataclass(frozen=True)
class _Call:
    """A call of a block."""

    kind: Kind
    number: int
    """Index of the unit among those of its kind."""
    frames_dim: int | None
    """Dimension of the output over frames, each of which is a unit; None for a single unit."""
    x: Tensor
    """Its input, [N, positions, ...]."""
    raw: Tensor
    """Its output."""
    leaf: Tensor
    """The output detached from its inputs, which others read."""

    def units(self, values: Tensor) -> Iterator[tuple[Unit, Tensor]]:
        """Its units, and their parts of its output or of the output's gradient."""
        parts = [values] if self.frames_dim is None else values.unbind(self.frames_dim)
        for frame, part in enumerate(parts):
            yield (self.kind, self.number, frame), part

    def mixing(self) -> Iterator[Unit]:
        """The units whose class token, or newest output, depends on other positions."""
        for unit, part in self.units(self.raw):
            if self.kind == "spatial":
                slope = _slopes(part[..., 0, :], [self.x])[0]
                others = None if slope is None else slope[:, 1:]
            else:
                slope = _slopes(part[:, -1] if part.ndim == 3 else part, [self.x])[0]
                others = None if slope is None else slope[:, :-1]
            if others is not None and others.any():
                yield unit


class _Tape:
    """Records the calls of a network's blocks, whose outputs it detaches.

    Args:
        network: the network, which is changed.
    """

    def __init__(self, network: HistoryNetwork) -> None:
        self.calls: list[_Call] = []
        self.numbers: Counter[Kind] = Counter()
        self.local: set[int] = set()  # spatial units without attention
        encoder = network.history_encoder
        for frames in [] if encoder.reads_frames else network.frames:
            if inner := inner_of(frames):
                self._watch("spatial", _inner_blocks(inner), frames_dim=0)
            else:
                self.local.add(self.numbers["spatial"])
                self._watch("spatial", [[frames]], frames_dim=1)
        if inner := inner_of(encoder):  # it sees all frames as one image
            self._watch("spatial", _inner_blocks(inner))
        elif not encoder.reads_frames:
            self._watch("temporal", _history_blocks(encoder))

    def _watch(
        self, kind: Kind, units: Sequence[Sequence[nn.Module]], frames_dim: int | None = None
    ) -> None:
        """Records the calls of units, each of one or more modules, that are called in order."""
        numbers = [self.numbers[kind] + index for index, unit in enumerate(units) for _ in unit]
        upcoming = iter(numbers)
        self.numbers[kind] += len(units)

        def record(module: nn.Module, inputs: Any, output: Any) -> Any:
            raw, *rest = output if isinstance(output, tuple) else (output,)
            leaf = raw.detach().requires_grad_()
            call = _Call(kind, next(upcoming), frames_dim, inputs[0], raw, leaf)
            self.calls.append(call)
            return (leaf, *rest) if rest else leaf

        for module in dict.fromkeys(itertools.chain(*units)):  # blocks can share their weights
            module.register_forward_pre_hook(_require_gradient)
            module.register_forward_hook(record)

    def count(self, output: Tensor) -> Flows:
        """Counts the flows, given the output of the history encoder."""
        edges: set[tuple[Unit, Unit]] = set()
        mixing: set[Unit] = set()
        for index, call in enumerate(self.calls):
            if call.kind == "temporal" or call.number not in self.local:
                mixing.update(call.mixing())
            for unit, part in call.units(call.raw):
                readable = _read_by(part, self.calls[:index])
                edges.update((other, unit) for other in readable if other != unit)
        vertical = Counter((a[0], b[0]) for a, b in edges)
        horizontal = Counter(unit[0] for unit in mixing)
        to_output = len({unit for unit in _read_by(output, self.calls) if unit[0] == "temporal"})
        return Flows(
            spatial=horizontal["spatial"],
            temporal=horizontal["temporal"],
            spatial_to_spatial=vertical["spatial", "spatial"],
            temporal_to_temporal=vertical["temporal", "temporal"]
            + (to_output if to_output > 1 else 0),
            spatial_to_temporal=vertical["spatial", "temporal"],
            temporal_to_spatial=vertical["temporal", "spatial"],
            temporal_to_output=to_output,
        )


def _inner_blocks(inner: InnerTransformer) -> list[list[nn.Module]]:
    return [[inner.blocks[index % len(inner.blocks)]] for index in range(inner.num_blocks)]


def _history_blocks(encoder: HistoryEncoder) -> list[list[nn.Module]]:
    """The modules of each unit of a history encoder, in the order in which they are called."""
    if isinstance(encoder, Catformer):
        return [list(pair) for pair in zip(encoder.attentions, encoder.ffns, strict=True)]
    if isinstance(encoder, RecurrentEncoder):
        return [[encoder]]
    blocks = getattr(encoder, "blocks", None)
    if blocks is None:
        if any("attention" in name for name, _ in encoder.named_modules()):
            raise ValueError(
                f"{type(encoder).__name__} has attention, but no blocks that are known here: name "
                "its blocks `blocks`, a ModuleList"
            )
        return []  # such as an MLP, which reads the frames as one vector
    number = getattr(encoder, "num_blocks", len(blocks))  # they can share their weights
    units = [[blocks[index % len(blocks)]] for index in range(number)]
    return [*units, [encoder.gate, encoder.lstm]] if isinstance(encoder, CoBERL) else units


def _require_gradient(module: nn.Module, inputs: tuple[Any, ...]) -> tuple[Any, ...]:
    x, *rest = inputs
    if x.is_floating_point() and not x.requires_grad:
        x = x.detach().requires_grad_()
    return (x, *rest)


def _draw_inputs(network: HistoryNetwork) -> list[Tensor]:
    """A random history of each observation, [1, K, *observation], and the further inputs."""
    inputs = []
    frames = network.num_frames
    for encoder, seen in zip(network.frames, network.observations.values(), strict=True):
        if seen.categories is not None:
            columns = [torch.randint(n, (1, frames, 1)) for n in seen.categories]
            inputs.append(torch.cat(columns, -1))
        else:
            inputs.append(torch.randn(1, frames, *seen.shape, dtype=torch.float64))
            if encoder.reads_entities:
                inputs[-1][..., -1] = 1  # none is padding
    history = network.history_encoder
    if isinstance(history, DecisionTransformer):
        inputs.append(torch.randn(1, frames, history.action_dim, dtype=torch.float64))
        inputs.append(torch.randn(1, frames, 1, dtype=torch.float64))
        inputs.append(torch.arange(frames).unsqueeze(0))
    return inputs


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
