"""TorchRL replay buffers over data sets, and a sampler of slices."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from msgspec import Meta
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, RandomSampler, ReplayBuffer

from torchrl_tit.datasets.online import OnlineHistoryStorage
from torchrl_tit.datasets.storages import EpisodeStorage
from torchrl_tit.settings.checks import checked_arguments
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
        storage: the data: transitions with histories
            (:class:`~torchrl_tit.datasets.HistoryStorage`) or windows
            (:class:`~torchrl_tit.datasets.SequenceStorage`).
        batch_size: items in a batch.
        seed: seed of the generator.
        slice_length: if it is more than 1, a batch is [batch_size / slice_length, slice_length]:
            slices of consecutive items (see :class:`~torchrl_tit.datasets.ConsecutiveSampler`).
        **settings: passed to `torchrl.data.ReplayBuffer`: ``transform``, ``prefetch``, another
            ``sampler``.

    Returns:
        The buffer; ``buffer.sample()`` gives a tensordict [batch_size].

    Raises:
        ValueError: if ``batch_size`` or ``slice_length`` is less than 1, or the second does not
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
    _check_divides(slice_length, batch_size)
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
        slice_length: number of items in a slice.
    """
    return RandomSampler() if slice_length == 1 else ConsecutiveSampler(slice_length)


class ConsecutiveSampler(RandomSampler):
    """Draws slices of consecutive steps, which may contain ends of episodes.

    Slices begin at any step, uniformly and with replacement, so every transition is equally likely
    to be drawn, including ends of episodes, except the first and last ``slice_length - 1`` steps of
    the storage. (TorchRL's `SliceSampler` keeps slices within episodes, which then draws an
    episode's first and last steps less often, and it reads the whole storage to find them.)

    Args:
        slice_length: number of steps in a slice, at least 1.

    Raises:
        ValueError: if it is less than 1; or, when sampling, if it does not divide the batch size or
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

    @checked_arguments
    def __init__(self, slice_length: Batch) -> None:
        super().__init__()
        self.slice_length = slice_length

    def sample(
        self, storage: EpisodeStorage | OnlineHistoryStorage, batch_size: int
    ) -> tuple[Tensor | tuple[Tensor, ...], dict[str, Any]]:
        """Draws indices, int64 [batch_size / slice_length, slice_length].

        Args:
            storage: steps of one environment or, in two dimensions, of several. No slice continues
                from the newest step to the oldest.
            batch_size: total number of steps.
        """
        _check_divides(self.slice_length, batch_size)
        steps, *envs = storage.shape or (0,)
        if steps < self.slice_length:
            raise ValueError(
                f"There are {steps} consecutive steps, which is less than a slice of "
                f"{self.slice_length}; choose a shorter slice_length."
            )
        device, count = storage.device, batch_size // self.slice_length

        # TorchRL gives its samplers the buffer's generator under this name only.
        def draw(high: int) -> Tensor:
            return torch.randint(high, (count, 1), generator=self._rng, device=device)

        offsets = torch.arange(self.slice_length, device=device) + storage.oldest
        time = (draw(steps - self.slice_length + 1) + offsets) % steps
        return (time, *(draw(size).expand_as(time) for size in envs)) if envs else time, {}


def _check_divides(slice_length: int, batch_size: int) -> None:
    if batch_size % slice_length:
        raise ValueError(
            f"A batch of {batch_size} steps cannot be divided into slices of {slice_length}; "
            f"choose a slice_length that divides it."
        )
