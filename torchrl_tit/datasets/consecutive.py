"""A sampler of slices of consecutive steps."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.data import RandomSampler, Storage


class ConsecutiveSampler(RandomSampler):
    """Draws slices of consecutive steps, which may contain ends of episodes.

    Slices begin at any step, uniformly and with replacement, so every transition is equally likely
    to be drawn, including ends of episodes, except the first and last ``slice_length - 1`` steps of
    the storage. (TorchRL's `SliceSampler` keeps slices within episodes, which then draws an
    episode's first and last steps less often, and it reads the whole storage to find them.)

    Args:
        slice_length: Number of steps in a slice, at least 1.

    Raises:
        ValueError: If it is less than 1; or, when sampling, if it does not divide the batch size or
            the storage has fewer steps.

    Example:
        >>> from torchrl_tit.datasets import HistoryStorage, episodes_from_arrays
        >>> states, ends = torch.arange(8.0).view(8, 1), torch.arange(8) % 4 == 3
        >>> storage = HistoryStorage(
        ...     episodes_from_arrays(states, states, states, ends), num_frames=3, is_init=True
        ... )
        >>> index, _ = ConsecutiveSampler(4).sample(storage, 12)
        >>> index.shape, storage[index]["history"].shape
        (torch.Size([3, 4]), torch.Size([3, 4, 3, 1]))
    """

    def __init__(self, slice_length: int) -> None:
        super().__init__()
        if slice_length < 1:
            raise ValueError(f"slice_length must be at least 1, not {slice_length}")
        self.slice_length = slice_length

    def sample(
        self, storage: Storage, batch_size: int
    ) -> tuple[Tensor | tuple[Tensor, ...], dict[str, Any]]:
        """Draws indices, int64 [batch_size / slice_length, slice_length].

        Args:
            storage: Items in the order of their steps, of one environment or, in two dimensions, of
                several. No slice continues from the newest step to the oldest.
            batch_size: Total number of steps.
        """
        if batch_size % self.slice_length:
            raise ValueError(
                f"A batch of {batch_size} steps cannot be divided into slices of "
                f"{self.slice_length}; choose a slice_length that divides it."
            )
        steps, *envs = storage.shape or (0,)
        if steps < self.slice_length:
            raise ValueError(
                f"There are {steps} consecutive steps, which is less than a slice of "
                f"{self.slice_length}; choose a shorter slice_length."
            )
        device, count = storage.device, batch_size // self.slice_length

        def draw(high: int) -> Tensor:
            return torch.randint(high, (count, 1), generator=storage._rng, device=device)

        newest = storage._last_cursor_index if storage._is_full else None
        oldest = 0 if newest is None else newest + 1
        offsets = torch.arange(oldest, oldest + self.slice_length, device=device)
        time = (draw(steps - self.slice_length + 1) + offsets) % steps
        return (time, *(draw(size).expand_as(time) for size in envs)) if envs else time, {}
