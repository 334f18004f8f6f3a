"""Histories of steps that were stored without them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

from torchrl_tit.windows import Padding, Windows, find_windows


def find_histories(
    steps: TensorDictBase, keys: Sequence[NestedKey], num_frames: int, padding: Padding
) -> Windows:
    """Finds the windows of steps drawn from a replay buffer; each stays within its slice.

    A window reaches back at most to the start of its episode or slice: t = 0, "is_init", a step
    after a done step, or one whose observation differs from the previous step's next observation.

    Args:
        steps: [*B, T], where the last dimension is time; flat batches [slices * steps] also work.
        keys: Keys of the observations.
        num_frames: Number K of frames in a window.
        padding: What replaces frames before a window's first valid one.

    Returns:
        Windows [*B, T, K] on the steps in order.

    Raises:
        ValueError: If the steps are single ones, or the starts cannot be found.

    Example:
        >>> from tensordict import TensorDict
        >>> frames, flags = torch.arange(4.0).view(4, 1), torch.zeros(4, 1, dtype=torch.bool)
        >>> following = TensorDict({"observation": frames + 1, "done": flags}, [4])
        >>> slices = TensorDict({"observation": frames, "next": following}, [4])[[0, 1, 0, 1]]
        >>> find_histories(slices, ["observation"], num_frames=2, padding="same").rows
        tensor([[0, 0],
                [0, 1],
                [2, 2],
                [2, 3]])
    """
    if not steps.ndim:
        raise ValueError("a single step has no history: the last dimension must be time")
    time = steps.ndim - 1
    starts = torch.zeros(steps.batch_size, dtype=torch.bool, device=steps[keys[0]].device)
    is_init, done = steps.get("is_init", None), steps.get(("next", "done"), None)
    if is_init is not None:
        starts |= is_init.flatten(time + 1).any(-1) if is_init.ndim > time + 1 else is_init
    if done is not None:
        starts[..., 1:] |= done[..., :-1, :].any(-1)
    starts[..., 0] = True
    starts |= _breaks(steps, keys, starts, known=done is not None)
    rows = torch.arange(starts.numel(), device=starts.device).view(starts.shape)
    oldest = torch.where(starts, rows, -1).cummax(time).values
    return find_windows(rows, oldest, num_frames, padding)


def _breaks(
    steps: TensorDictBase, keys: Sequence[NestedKey], starts: Tensor, known: bool
) -> Tensor:
    """Where a step does not follow the one before, bool [*B, T]."""
    breaks = torch.zeros_like(starts)
    time = steps.ndim - 1
    pairs = [(steps.get(key), steps.get(unravel_key(("next", key)), None)) for key in keys]
    if any(following is None for _, following in pairs):
        if not known or (steps.ndim == 1 and steps.names[0] != "time"):
            raise ValueError(
                "nothing tells where slices of these steps begin: store the next observations too, "
                'or reshape the steps to [slices, steps] and store ("next", "done")'
            )
        return breaks
    for now, following in pairs:
        now, after = (
            now.narrow(time, 1, now.shape[time] - 1),
            following.narrow(time, 0, now.shape[time] - 1),
        )
        differs = (now != after) & ((now == now) | (after == after))  # NaN differs from itself
        breaks[..., 1:] |= differs.unsqueeze(-1).flatten(time + 1).any(-1)
    inside = ~starts
    if (breaks & inside).sum() > (inside.sum() / 2):
        raise ValueError(
            "most of these steps do not follow the one before them, so they are no slices and have "
            "no histories: draw them with a SliceSampler, or store them in an "
            "OnlineHistoryStorage, which makes the histories of single steps"
        )
    return breaks
