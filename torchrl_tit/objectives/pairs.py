"""Features at s and at s', whose windows share all frames but one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor

from torchrl_tit.modules.backbone import Backbone, trunks_of
from torchrl_tit.modules.frame_tables import find_starts, table_of_stored
from torchrl_tit.networks import HistoryNetwork
from torchrl_tit.windows import Windows


def encode_pairs(
    network: TensorDictModuleBase, tensordict: TensorDictBase
) -> tuple[TensorDictBase, TensorDictBase]:
    """Runs a network's backbones at s and, without gradient, at s', encoding each frame once.

    The window at s' is the one at s, moved by one observation. So only the newest frame of s' is
    encoded, without storing activations; the other tokens are those of s, detached. Features and
    gradients are those of two separate calls, up to rounding. Dropout in a frame encoder is drawn
    once per frame, so s and s' see the same noise on the frames that they share.

    Run the network on the results within ``tensordict.nn.set_skip_existing(True)``, which skips the
    backbones, or get its distribution with :func:`get_dist`. Backbones without a frame encoder, and
    those that carry a state, have nothing to share and run in that call.

    Args:
        network: reads entries of a state; its weights can be functional (``params.to_module``).
        tensordict: transitions [*B], whose ("next", "history") is the history moved by one; or,
            with "is_init", slices [*B, T] of consecutive transitions, whose frames are shared too.
            Then "is_init", bool [*B, T, 1], is True where an episode begins.

    Returns:
        The network's inputs at s and at s', with the backbones' features.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl_tit import EnhancedTIT
        >>> frames = torch.randn(16, 9, 4)
        >>> here, there = encode_pairs(
        ...     Backbone(EnhancedTIT((4,), num_frames=8)),
        ...     TensorDict({"history": frames[:, :8], "next": {"history": frames[:, 1:]}}, [16]),
        ... )
        >>> here["features"].requires_grad, there["features"].requires_grad
        (True, False)
    """
    following = tensordict["next"]
    here = tensordict.select(*network.in_keys, strict=False)
    there = following.select(*network.in_keys, strict=False)
    for backbone in network.modules():
        if not isinstance(backbone, Backbone) or not _shares_frames(backbone):
            continue
        trunks = list(trunks_of(backbone.module).values())
        pairs = _lay_out(backbone, trunks[0], tensordict)
        with backbone.computing(pairs.rows.device):
            encoded = [_encode(trunk, pairs) for trunk in trunks]
        shape = tensordict.batch_size
        for key, (features, next_features) in zip(backbone.features_keys, encoded, strict=True):
            for group, value in ((here, features), (there, next_features)):
                value = value if backbone.autocast is None else value.float()
                group.set(key, value.reshape(*shape, value.shape[-1]))
    return here, there


def get_dist(policy: ProbabilisticTensorDictSequential, tensordict: TensorDictBase) -> Any:
    """Gets a policy's distribution, skipping backbones whose features are already computed.

    Like ``policy.get_dist`` within ``set_skip_existing(True)``, which ``torch.compile`` cannot
    trace.

    Args:
        policy: modules in a sequence, the last of which makes the distribution.
        tensordict: the policy's inputs, or a result of :func:`encode_pairs`.
    """
    *modules, last = _in_sequence(policy)
    for module in modules:
        done = isinstance(module, Backbone) and all(
            tensordict.get(key, None) is not None for key in module.features_keys
        )
        tensordict = tensordict if done else module(tensordict)
    return last.get_dist(tensordict)


def _in_sequence(module: TensorDictModuleBase) -> list[Any]:
    """Lists the modules of nested sequences."""
    if not isinstance(module, TensorDictSequential):
        return [module]
    return [inner for outer in module.module for inner in _in_sequence(outer)]


class _Pairs(NamedTuple):
    """The frames of the windows at s and at s', and their rows."""

    frames: list[Tensor]
    """For each observation, the frames in windows at s; [R, *observation_shape]."""
    extra: list[Tensor]
    """The other frames, which only s' sees; [E, *observation_shape]."""
    rows: Tensor
    """Rows of each window at s, in ``frames``; int64 [..., K]."""
    next_rows: Tensor
    """Rows of each window at s', in ``frames`` followed by ``extra``; int64 [..., K]."""


def _lay_out(backbone: Backbone, trunk: HistoryNetwork, tensordict: TensorDictBase) -> _Pairs:
    """Lays out the frames of transitions."""
    is_init = tensordict.get("is_init", None)
    stored = [[group.get(key) for key in backbone.history_keys] for group in _groups(tensordict)]
    for histories in stored:
        trunk.check(*histories)
    if is_init is None:
        histories, following = ([x.flatten(0, tensordict.ndim - 1) for x in xs] for xs in stored)
        return _lay_out_single(histories, [x[:, -1] for x in following])
    histories, following = ([x.flatten(0, tensordict.ndim - 2) for x in xs] for xs in stored)
    count, steps = histories[0].shape[:2]
    flags = [is_init, tensordict.get(("next", "done"), None)]
    first, *ends = (x.reshape(count, steps, -1).any(-1) for x in flags if x is not None)
    return _lay_out_slices(histories, [x[:, :, -1] for x in following], find_starts(first, ends))


def _groups(tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
    return tensordict, tensordict["next"]


def _lay_out_single(histories: Sequence[Tensor], newest: Sequence[Tensor]) -> _Pairs:
    """Lays out single transitions, with static shapes.

    Args:
        histories: at s, [N, K, *observation_shape] each.
        newest: at s', [N, *observation_shape] each.
    """
    count, num_frames = histories[0].shape[:2]
    rows = torch.arange(count * num_frames, device=histories[0].device).view(count, num_frames)
    extra = rows.numel() + torch.arange(count, device=rows.device)
    frames = [history.flatten(0, 1) for history in histories]
    return _Pairs(frames, list(newest), rows, _move(rows, extra))


def _lay_out_slices(
    histories: Sequence[Tensor], newest: Sequence[Tensor], starts: Tensor
) -> _Pairs:
    """Lays out slices: s' is mostly the s of the next step, whose newest frame is already there.

    Args:
        histories: at s, [N, T, K, *observation_shape] each.
        newest: at s', [N, T, *observation_shape] each.
        starts: bool [N, T], where the history does not continue that of the step before.
    """
    frames, windows, _ = table_of_stored(histories, [x[:, :, -1] for x in histories], starts)
    alone = torch.cat([starts[:, 1:], torch.ones_like(starts[:, :1])], dim=1)  # s' is no step's s
    extra = frames[0].shape[0] - 1 + alone.flatten().cumsum(0).view(alone.shape)
    following = torch.where(alone, extra, windows.rows[..., -1] + 1)
    return _Pairs(frames, [x[alone] for x in newest], windows.rows, _move(windows.rows, following))


def _move(rows: Tensor, newest: Tensor) -> Tensor:
    """Moves windows by one: int64 [..., K] and [...] -> [..., K]."""
    return torch.cat([rows[..., 1:], newest.unsqueeze(-1)], dim=-1)


def _encode(trunk: HistoryNetwork, pairs: _Pairs) -> tuple[Tensor, Tensor]:
    """Returns the features at s and at s', float [..., F] each; those at s' without gradient."""
    tokens = _tokens(trunk, pairs.frames)
    features = trunk.encode_history(Windows(pairs.rows, None).gather(tokens))
    with torch.no_grad():
        tokens = torch.cat([tokens, _tokens(trunk, pairs.extra)])
        return features, trunk.encode_history(Windows(pairs.next_rows, None).gather(tokens))


def _tokens(trunk: HistoryNetwork, frames: Sequence[Tensor]) -> Tensor:
    encoded = [encoder(table) for encoder, table in zip(trunk.frames, frames, strict=True)]
    return trunk.join_tokens(encoded)


def _shares_frames(backbone: Backbone) -> bool:
    """Whether encoding the frames of s and s' once saves work."""
    trunks = trunks_of(backbone.module).values()
    reads_more = any(trunk.history_encoder.context for trunk in trunks)
    return backbone.keeps_frames and not backbone.is_recurrent and not reads_more
