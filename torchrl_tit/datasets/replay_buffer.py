"""TorchRL replay buffers over data sets."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from msgspec import Meta
from torchrl.data import ImmutableDatasetWriter, ReplayBuffer
from torchrl.data.replay_buffers.samplers import RandomSampler

from torchrl_tit.datasets.consecutive import ConsecutiveSampler
from torchrl_tit.datasets.storage import EpisodeStorage
from torchrl_tit.settings.arguments import checked_arguments
from torchrl_tit.settings.numbers import Batch

AnySeed = Annotated[int, Meta(ge=0, le=2**62)]


@checked_arguments
def make_replay_buffer(
    storage: EpisodeStorage,
    batch_size: Batch,
    *,
    seed: AnySeed = 0,
    slice_length: Batch = 1,
    **settings: Any,
) -> ReplayBuffer:
    """Makes a replay buffer that draws items uniformly, with replacement.

    The buffer has its own random generator, which is part of its ``state_dict()``: a buffer that
    loads the state continues with the same batches. The data are not part of the state.

    Args:
        storage: The data: transitions with histories
            (:class:`~torchrl_tit.datasets.HistoryStorage`) or windows
            (:class:`~torchrl_tit.datasets.SequenceStorage`).
        batch_size: Items in a batch.
        seed: Seed of the generator.
        slice_length: If it is more than 1, a batch is [batch_size / slice_length, slice_length]:
            slices of consecutive items (see :class:`~torchrl_tit.datasets.ConsecutiveSampler`).
        **settings: Passed to `torchrl.data.ReplayBuffer`: ``transform``, ``prefetch``, another
            ``sampler``.

    Returns:
        The buffer; ``buffer.sample()`` gives a tensordict [batch_size].

    Raises:
        ValueError: If ``batch_size`` or ``slice_length`` is less than 1, or the second does not
            divide the first.

    Example:
        >>> import numpy as np
        >>> from torchrl_tit.datasets import HistoryStorage, episodes_from_arrays
        >>> ends = np.array([False, True, False, True])
        >>> episodes = episodes_from_arrays(np.ones((4, 2)), np.ones((4, 1)), np.ones(4), ends)
        >>> buffer = make_replay_buffer(HistoryStorage(episodes, num_frames=3), batch_size=8)
        >>> buffer.sample()["next", "history"].shape
        torch.Size([8, 3, 2])
    """
    if batch_size % slice_length:
        raise ValueError(
            f"A batch of {batch_size} steps cannot be divided into slices of {slice_length}; "
            f"choose a slice_length that divides it."
        )
    return ReplayBuffer(
        storage=storage,
        writer=ImmutableDatasetWriter(),
        batch_size=batch_size,
        generator=torch.Generator(storage.device).manual_seed(seed),
        **{"sampler": make_sampler(slice_length), **settings},
    )


def make_sampler(slice_length: int) -> RandomSampler:
    """Makes a sampler of single items, or of slices if ``slice_length`` is not 1.

    Args:
        slice_length: Number of items in a slice.
    """
    return RandomSampler() if slice_length == 1 else ConsecutiveSampler(slice_length)
