"""A network that is called at every step of an environment, and only encodes the newest frames."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchrl_tit.modules.frame_cache import Encode, FrameCache
from torchrl_tit.networks import HistoryNetwork


class ActingNetwork:
    """Maps histories to features, and keeps the tokens of the frames for the next call.

    Args:
        network: the network (see :class:`FrameCache` for weights that change).

    Example:
        >>> from torchrl_tit import EnhancedTIT
        >>> network = EnhancedTIT((4,), num_frames=8)
        >>> acting, frames = ActingNetwork(network), torch.randn(16, 9, 4)
        >>> with torch.no_grad():
        ...     first = acting(frames[:, :8])  # encodes 8 frames of each of 16 environments
        ...     second = acting(frames[:, 1:])  # encodes 1 frame of each
        >>> torch.allclose(second, network(frames[:, 1:]), atol=1e-4)
        True
    """

    def __init__(self, network: HistoryNetwork) -> None:
        self.network = network
        self._encode_history = network.encode_history
        self._encode_newest: list[Encode] = list(network.frames)
        self.clear()

    def compile(self, **options: Any) -> None:
        """Compiles the encoding of the newest frames, and everything after the frame encoders.

        Between the two, plain Python decides which tokens can be reused.

        Args:
            **options: passed to ``torch.compile``.
        """
        self._encode_history = torch.compile(self.network.encode_history, **options)
        self._encode_newest = [torch.compile(frame, **options) for frame in self.network.frames]
        self.clear()

    def __call__(self, *inputs: Tensor) -> Tensor:
        """Maps histories to features; see :meth:`HistoryNetwork.forward`."""
        caches = self._caches
        histories, context = inputs[: len(caches)], inputs[len(caches) :]
        self.network.check(*histories)
        tokens = [cache(history) for cache, history in zip(caches, histories, strict=True)]
        return self._encode_history(self.network.join_tokens(tokens), *context)

    def clear(self) -> None:
        """Discards the tokens, so that the next histories are encoded like the first ones.

        Can be called from another thread: tokens that a running call still computes are not kept.
        """
        self._caches = [
            FrameCache(encoder, len(encoder.observation_shape), encode_newest)
            for encoder, encode_newest in zip(self.network.frames, self._encode_newest, strict=True)
        ]
