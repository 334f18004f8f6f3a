"""A network that is called at every step of an environment, and encodes the newest frames only."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchrl_tit.frames import FrameEncoder
from torchrl_tit.modules.frame_cache import Encode, FrameCache
from torchrl_tit.networks import HistoryNetwork


class ActingNetwork:
    """Maps histories to features, and keeps the tokens of the frames for the next call.

    Copies and pickles keep nothing, and run uncompiled.

    Args:
        network: the network.

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
        self._compiled_encoders: dict[FrameEncoder, Encode] = {}
        self._caches: dict[int, FrameCache] = {}  # by the index of the observation

    def compile(self, **options: Any) -> None:
        """Compiles the encoding of the newest frames, and everything after the frame encoders.

        Which tokens can be reused is decided in between, in plain Python.

        Args:
            **options: passed to ``torch.compile``.
        """
        self._encode_history = torch.compile(self.network.encode_history, **options)
        self._compiled_encoders = {
            encoder: torch.compile(encoder, **options) for encoder in self.network.frames
        }

    def fresh(self) -> ActingNetwork:
        """Returns a copy without kept tokens that shares the compiled parts."""
        other = ActingNetwork(self.network)
        other._encode_history = self._encode_history
        other._compiled_encoders = self._compiled_encoders
        return other

    def __call__(self, *inputs: Tensor) -> Tensor:
        """Maps histories to features; see :meth:`HistoryNetwork.forward`."""
        encoders = self.network.frames
        histories, context = inputs[: len(encoders)], inputs[len(encoders) :]
        self.network.check(*histories)
        tokens = [
            self._cache(index, encoder)(history)
            for index, (encoder, history) in enumerate(zip(encoders, histories, strict=True))
        ]
        return self._encode_history(self.network.join_tokens(tokens), *context)

    def clear(self) -> None:
        """Discards the tokens, so that the next histories are encoded like the first ones."""
        self._caches.clear()

    def _cache(self, index: int, encoder: FrameEncoder) -> FrameCache:
        """The cache of an observation; a new one if its encoder has been replaced."""
        cache = self._caches.get(index)
        if cache is None or cache.encoder is not encoder:
            compiled = self._compiled_encoders.get(encoder)
            cache = FrameCache(encoder, len(encoder.observation_shape), compiled)
            self._caches[index] = cache
        return cache

    def __getstate__(self) -> dict[str, Any]:
        return {"network": self.network}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]
