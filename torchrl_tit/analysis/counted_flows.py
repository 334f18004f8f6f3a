"""The paper's table of information flows, counted from a network's settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torchrl_tit import settings
from torchrl_tit.settings import (
    GRU,
    LSTM,
    MLP,
    Catformer,
    ChainedOuter,
    CoBERL,
    DecisionTransformer,
    GTrXL,
    HistorySettings,
    Inner,
    Outer,
    PairedOuter,
    StackedCNN,
    StackedInner,
)
from torchrl_tit.settings.histories import D2RL, OFENet


@dataclass(frozen=True)
class Flows:
    """Numbers of flows of information in a network (arXiv 2212.14538, table of flows)."""

    spatial: int
    """Horizontal, within a frame: blocks whose attention mixes its patches, over all frames."""
    temporal: int
    """Horizontal, over frames: blocks whose attention or recurrence mixes the K steps."""
    spatial_to_spatial: int
    """Vertical, S-S: from a block on a frame to the next block on this frame."""
    temporal_to_temporal: int
    """Vertical, T-T: from a block over the frames to another one, or to a dense connection."""
    spatial_to_temporal: int
    """Vertical, S-T: from a frame's encoder to a block over the frames."""
    temporal_to_spatial: int
    """Vertical, T-S: from a block over the frames to a frame's encoder."""


def count_flows(network: settings.Network) -> Flows:
    """Counts the flows of information in a network.

    The rule, which gives the numbers that the paper prints:

    - A *unit* is a block in one place: an inner block on one of the K frames is a spatial unit, a
      block over the frames is a temporal one. A frame encoder without attention is a single spatial
      unit per frame, with no spatial flow: convolutions are local, as the paper says of ResNet.
    - A *horizontal* flow goes through each unit whose attention (or recurrence) mixes all patches,
      or all frames.
    - A *vertical* flow goes from a unit to each unit that reads its output directly. A dense
      connection, which concatenates the outputs of all blocks, counts as a temporal unit if it
      reads temporal ones: so Enhanced_TIT has L flows T-T, although none of its outer blocks reads
      another one.

    With L blocks and K frames, this gives for Vanilla_TIT and Enhanced_TIT: spatial LK and LK,
    temporal L and L, S-S (L - 1)K and (L - 1)K, T-T L - 1 and L, S-T K and LK, T-S 0 and 0.
    Networks that stack the frames as channels, or as entries, mix them without any flow of this
    kind. With several observations, only ``network.frame`` is counted.
    :func:`~torchrl_tit.analysis.measure_flows` measures the actual dependencies.

    Source: arXiv 2212.14538, appendix "Discussion and Improvement".

    Args:
        network: the settings.

    Raises:
        ValueError: if the history encoder is user-defined, for which there is no rule.

    Example:
        >>> from torchrl_tit.settings.networks import enhanced_tit
        >>> flows = count_flows(enhanced_tit(4, num_blocks=2))
        >>> flows.spatial, flows.temporal, flows.temporal_to_temporal, flows.spatial_to_temporal
        (8, 2, 2, 8)
    """
    frame, history, frames = network.frame, network.history, network.num_frames
    if isinstance(history, StackedInner):  # its blocks see all frames at once
        blocks = history.num_blocks
        return Flows(blocks, 0, blocks - 1, 0, 0, 0)
    blocks, tokens = 0, 1
    if isinstance(frame, Inner):
        blocks = frame.num_blocks
        tokens = blocks if frame.every_block else 1
    rule = _RULES.get(type(history))
    if rule is None:
        known = ", ".join(sorted(kind.name for kind in _RULES))
        raise ValueError(
            f"no rule counts the flows of the history encoder {history.name!r}: there is one for "
            f"{known}"
        )
    dense = isinstance(frame, Inner) and frame.every_block
    temporal, between, read = rule(history, tokens, dense)
    return Flows(
        spatial=blocks * frames,
        temporal=temporal,
        spatial_to_spatial=max(blocks - 1, 0) * frames,
        temporal_to_temporal=between,
        spatial_to_temporal=read * frames,
        temporal_to_spatial=0,  # a frame's tokens depend on that frame alone
    )


def _nothing(history: Any, tokens: int, dense: bool) -> tuple[int, int, int]:
    return 0, 0, 0


def _one_state(history: Any, tokens: int, dense: bool) -> tuple[int, int, int]:
    return 1, 0, tokens


def _stacked(history: Any, tokens: int, dense: bool) -> tuple[int, int, int]:
    return history.num_blocks, history.num_blocks - 1, tokens


def _outer(history: Outer, tokens: int, dense: bool) -> tuple[int, int, int]:
    connected = history.num_blocks if history.dense else 0
    return history.num_blocks, history.num_blocks - 1 + connected, tokens


def _paired(history: PairedOuter, tokens: int, dense: bool) -> tuple[int, int, int]:
    return tokens, tokens if dense else 0, tokens


def _chained(history: ChainedOuter, tokens: int, dense: bool) -> tuple[int, int, int]:
    return tokens, tokens - 1 + (tokens if dense else 0), tokens


def _catformer(history: Catformer, tokens: int, dense: bool) -> tuple[int, int, int]:
    # Each block reads all previous ones; only the first one reads the tokens.
    blocks = history.num_blocks
    return blocks, blocks * (blocks - 1) // 2, tokens


def _coberl(history: CoBERL, tokens: int, dense: bool) -> tuple[int, int, int]:
    # Its LSTM is a block, which also reads the tokens through a gate.
    return history.num_blocks + 1, history.num_blocks, 2 * tokens


_RULES: dict[type[HistorySettings], Callable[[Any, int, bool], tuple[int, int, int]]] = {
    Outer: _outer,
    PairedOuter: _paired,
    ChainedOuter: _chained,
    GTrXL: _stacked,
    DecisionTransformer: _stacked,
    Catformer: _catformer,
    CoBERL: _coberl,
    LSTM: _one_state,
    GRU: _one_state,
    MLP: _nothing,
    OFENet: _nothing,
    D2RL: _nothing,
    StackedCNN: _nothing,
}
"""Functions of a history encoder's settings, the tokens per frame, and whether these come from all
blocks. They return its temporal units, the flows between them, and those that it reads from a
frame."""
