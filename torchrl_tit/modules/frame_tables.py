"""Sequences of consecutive steps as a table that holds each frame once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_tit.settings.choices import Padding
from torchrl_tit.windows import Windows, differs, find_windows


class FrameTable(NamedTuple):
    """The frames of sequences, and the window of each step.

    Attributes:
        frames: the table of each observation, [R, *observation_shape].
        windows: the window of each step, [N, T, K].
        valid: bool [N, T], False where the window would begin before the sequence does; None if
            the histories at the starts are known.
    """

    frames: list[Tensor]
    windows: Windows
    valid: Tensor | None = None


def table_of_stored(
    histories: Sequence[Tensor], observations: Sequence[Tensor], starts: Tensor
) -> FrameTable:
    """Reads the stored histories at the starts of sequences, and the newest observation elsewhere.

    A history that does not continue the one before it begins a sequence, too: losses that select
    a network's ``in_keys`` drop "done", and a shuffled step continues nothing.

    The number of frames depends on the data, so ``torch.compile`` breaks its graph here, and
    ``vmap`` cannot map over ``starts``.

    Args:
        histories: [N, T, K, *observation_shape] each.
        observations: [N, T, *observation_shape] each.
        starts: bool [N, T], where a sequence begins; at the first step in any case.
    """
    num_frames = histories[0].shape[2]
    starts = starts.clone()
    for history in histories:
        starts[:, 1:] |= differs(history[:, 1:, :-1], history[:, :-1, 1:])
    newest = torch.where(starts, num_frames, 1).flatten().cumsum(0) - 1  # int64 [N * T]
    places = newest[starts.flatten()].unsqueeze(-1) + torch.arange(
        1 - num_frames, 1, device=starts.device
    )
    frames = []
    for history, observation in zip(histories, observations, strict=True):
        table = observation.new_empty(int(newest[-1]) + 1, *observation.shape[2:])
        table[newest] = observation.flatten(0, 1)
        table[places] = history[starts]
        frames.append(table)
    rows = newest.view(starts.shape)
    return FrameTable(frames, find_windows(rows, rows - num_frames + 1, num_frames, "same"))


def table_of_first(
    first: Sequence[Tensor], observations: Sequence[Tensor], is_init: Tensor, padding: Padding
) -> FrameTable:
    """Reads only the first step's stored history, and pads before later episodes.

    All shapes are static.

    Args:
        first: the histories at the first step, [N, K, *observation_shape] each.
        observations: [N, T, *observation_shape] each.
        is_init: bool [N, T], where an episode begins.
        padding: what precedes its first observation.
    """
    num_frames = first[0].shape[1]
    frames = [
        torch.cat([history[:, :-1], observation], dim=1)
        for history, observation in zip(first, observations, strict=True)
    ]
    start = _last_start(_after_first(is_init, False))
    return FrameTable(*_cut(frames, start, num_frames, padding))


def table_without_histories(
    observations: Sequence[Tensor],
    is_init: Tensor,
    starts: Tensor,
    num_frames: int,
    padding: Padding,
) -> FrameTable:
    """Pads before sequences, and marks the windows that are the same as in acting.

    All shapes are static.

    Args:
        observations: [N, T, *observation_shape] each.
        is_init: bool [N, T], where an episode begins.
        starts: bool [N, T], where a sequence begins.
        num_frames: number K of frames in a window.
        padding: what precedes a sequence's first observation.
    """
    start = _last_start(starts)
    steps = torch.arange(starts.shape[1], device=starts.device)
    valid = (steps - start >= num_frames - 1) | is_init.gather(1, start)
    return FrameTable(*_cut(observations, start, num_frames, padding), valid)


def _cut(
    frames: Sequence[Tensor], start: Tensor, num_frames: int, padding: Padding
) -> tuple[list[Tensor], Windows]:
    """Cuts the windows of sequences, whose frames may begin before their first step.

    Args:
        frames: [N, S + T, *observation_shape] each, of which S precede the first step.
        start: step at which the episode of each step begins, int64 [N, T]; 0 also stands for the
            first of the S frames.
        num_frames: number K of frames in a window.
        padding: what precedes an episode's first observation.
    """
    (count, steps), span = start.shape, frames[0].shape[1]
    newest = torch.arange(span - steps, span, device=start.device)
    oldest = torch.where(start == 0, 0, start + span - steps)
    offset = torch.arange(count, device=start.device).unsqueeze(-1) * span
    windows = find_windows(offset + newest, offset + oldest, num_frames, padding)
    return [table.flatten(0, 1) for table in frames], windows._replace(span=span)


def find_starts(is_init: Tensor, ends: Sequence[Tensor]) -> Tensor:
    """Finds where sequences begin: at the first step, at episode starts, and after done steps.

    TorchRL's `SliceSampler` marks the last step of each slice as done, so this also finds the
    slices of a flat batch.

    Args:
        is_init: bool [N, T].
        ends: flags of the steps before a start, bool [N, T] each.

    Returns:
        bool [N, T].
    """
    for end in ends:
        is_init = is_init | end.roll(1, dims=1)
    return _after_first(is_init, True)


def _after_first(mask: Tensor, first: bool) -> Tensor:
    """Replaces a mask's first step; bool [N, T] -> [N, T]."""
    return torch.cat([torch.full_like(mask[:, :1], first), mask[:, 1:]], dim=1)


def _last_start(starts: Tensor) -> Tensor:
    """The step of the last start at or before each step, or 0; bool [N, T] -> int64 [N, T]."""
    steps = torch.arange(starts.shape[1], device=starts.device)
    return torch.where(starts, steps, 0).cummax(dim=1).values
