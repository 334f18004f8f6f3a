"""Attention of the newest frame of many windows, with each frame of a table projected once."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_tit.layers.attention import RelativeSelfAttention, SelfAttention
from torchrl_tit.windows import Windows, take

_LARGEST_SPAN = 16
"""Rows of a sequence per frame of a window, up to which one product of all pairs is faster."""


def worth_a_table(windows: Windows) -> bool:
    """Whether :func:`attend_windows` takes these windows, and is faster than copies of them."""
    return windows.span is not None and windows.span <= _LARGEST_SPAN * windows.rows.shape[-1]


def attend_windows(
    attention: SelfAttention | RelativeSelfAttention, x: Tensor, windows: Windows
) -> Tensor:
    """Reads the newest token of windows.

    The result is that of ``attention(windows.gather(x), read="last")``, up to rounding. There, a
    token is projected and rotated anew in each of the K windows that hold it. Here all queries of a
    sequence meet all of its keys, once, and what lies outside of a window is masked; padding, where
    one key has several distances, follows as K further columns.

    Args:
        attention: the layer.
        x: tokens of a table, float [R, D].
        windows: windows of sequences, [N, T, K], with their ``span``, none missing.

    Returns:
        float [N, T, D].
    """
    count, _, num_frames = windows.rows.shape
    span = windows.span or 0
    padded = windows.padded()  # [N, T, K]
    rows = torch.arange(count * span, device=x.device).view(count, 1, span)
    back = windows.rows[..., -1:] - rows  # how many steps, [N, T, span]
    within = (back >= 0) & (back < num_frames - padded.sum(-1, keepdim=True))

    per_head = attention.split_heads  # [N, S, D] -> [N, heads, S, D / heads]
    oldest, newest = windows.rows[..., 0], windows.rows[..., -1]
    keys, values = attention.project(x, 1, 3).chunk(2, dim=-1)  # [R, D]
    oldest_key, oldest_value = (per_head(take(table, oldest)) for table in (keys, values))
    key, value = (per_head(table[: count * span].view(count, span, -1)) for table in (keys, values))
    query = per_head(attention.project(take(x, newest), 0, 1))  # [N, heads, T, D / heads]
    scores, padding = attention.window_scores(query, key, oldest_key, back, num_frames)
    seen = torch.cat([within, padded], dim=-1).unsqueeze(1)
    weights = torch.cat([scores, padding], dim=-1).masked_fill(~seen, -math.inf).softmax(dim=-1)
    if isinstance(attention, SelfAttention):
        weights = attention.dropout(weights)
    of_rows, of_padding = weights.split([span, num_frames], dim=-1)
    mixed = of_rows @ value + of_padding.sum(-1, keepdim=True) * oldest_value
    return attention.out_proj(mixed.transpose(1, 2).flatten(2))
