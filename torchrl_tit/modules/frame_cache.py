"""Keeps the tokens of the last frames, so that acting encodes only the newest one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_tit.modules.torch_internals import Weights, is_recorded, mode_dependent
from torchrl_tit.networks import HistoryNetwork

Encode = Callable[[Tensor], Tensor]


class FrameCache:
    """Encodes windows of K frames, and reuses the tokens of the frames of the previous call.

    A frame's tokens depend on that frame alone. While acting, each step's window is the previous
    step's window, moved by one frame, so K - 1 of its frames have already been encoded.

    Any windows are allowed. Tokens are reused only if the frame equals the one they were computed
    from, in the same row of the batch, one place later in the window. All other frames are encoded;
    a frame that occurs several times is encoded once. So the first window of an episode, padded
    with copies of one observation or with zeros, costs one or two frames. The output is that of the
    encoder, up to rounding: the last bits may differ between a frame encoded alone and in a batch.

    Tokens are kept while each parameter and buffer of the encoder is the same tensor of the same
    version, PyTorch's count of writes. So a loaded state dict, ``to_module``, ``copy_`` and most
    optimizers are noticed. Writes through ``.data``, through shared memory and by fused optimizers
    leave no trace, and modules that replace others are not looked for: call :meth:`clear`
    afterwards, or the previous frames keep the tokens of the old weights.

    Nothing is kept or reused while gradients are enabled, dropout or batch normalization is active
    in the encoder, ``to_module`` has put tensors in the place of parameters, under ``vmap`` and the
    other transforms of ``torch.func``, or while ``torch.compile``, ``torch.export`` or a CUDA graph
    is recording.

    Args:
        encoder: maps observations [..., *observation_shape] to tokens [..., *token_shape], each
            independently of the others; its only randomness is the dropout of PyTorch's modules.
        observation_ndim: number of dimensions of an observation.
        encode_newest: encodes the newest frame of each window; the encoder itself by default, or
            the compiled encoder.

    Example:
        >>> from torchrl_tit import EnhancedTIT
        >>> tit = EnhancedTIT(observation_shape=(4,), num_frames=8)
        >>> cache = FrameCache(tit.frames[0], observation_ndim=1)
        >>> frames = torch.randn(16, 9, 4)
        >>> with torch.no_grad():
        ...     first = cache(frames[:, :8])  # 8 frames of each of 16 environments
        ...     second = cache(frames[:, 1:])  # 1 frame
        >>> first.shape, torch.equal(second[:, :-1], first[:, 1:])
        (torch.Size([16, 8, 2, 32]), True)
    """

    def __init__(
        self, encoder: nn.Module, observation_ndim: int, encode_newest: Encode | None = None
    ) -> None:
        self.encoder = encoder
        """Maps observations to tokens."""
        self._observation_ndim = observation_ndim
        self._encode_newest = encoder if encode_newest is None else encode_newest
        self._mode_dependent = mode_dependent(encoder)
        self._weights = Weights(encoder)
        self._kept: _Kept | None = None

    def clear(self) -> None:
        """Discards everything, so that the next window is encoded like the first one."""
        self._kept = None

    def __call__(self, window: Tensor) -> Tensor:
        """Encodes windows.

        Args:
            window: [..., K, *observation_shape], oldest first.

        Returns:
            float [..., K, *token_shape].
        """
        conditions = self._conditions(window)
        if conditions is None:
            return self.encoder(window)
        kept = self._kept if self._kept and self._kept.conditions == conditions else None
        leading = window.shape[: window.ndim - self._observation_ndim - 1]
        frames = window.reshape(math.prod(leading), *window.shape[len(leading) :])  # [N, K, *obs]
        flat = _as_words(frames.flatten(2))  # [N, K, entries]
        newest = self._encode_newest(frames[:, -1]).unsqueeze(1)  # [N, 1, *token_shape]
        if kept and torch.equal(flat[:, :-1], kept.frames):
            older = kept.tokens
        else:
            older = self._encode_older(frames, flat, newest, kept)
        tokens = torch.cat([older, newest], dim=1)
        weights = kept.weights if kept else self._weights.present()
        # Copies, because what is read and returned may be written to.
        self._kept = _Kept(conditions, weights, flat[:, 1:].clone(), tokens[:, 1:].clone())
        return tokens.reshape(*leading, *tokens.shape[1:])

    def _encode_older(
        self, frames: Tensor, flat: Tensor, newest: Tensor, kept: _Kept | None
    ) -> Tensor:
        """Tokens of all frames but the newest, [N, K - 1, *token_shape]; some are known."""
        older = flat[:, :-1]
        unknown = (older != flat[:, -1:]).any(-1)
        tokens = newest.repeat(1, older.shape[1], *[1] * (newest.ndim - 2))
        if kept is not None:
            known = (older == kept.frames).all(-1)
            tokens[known] = kept.tokens[known]
            unknown &= ~known
        if unknown.any():
            distinct, index = older[unknown].unique(dim=0, return_inverse=True)
            distinct = distinct.view(frames.dtype).unflatten(-1, frames.shape[2:])
            tokens[unknown] = self.encoder(distinct)[index]
        return tokens

    def _conditions(self, window: Tensor) -> tuple[object, ...] | None:
        """What must be the same for tokens to be reused; None if they cannot be.

        Reused tokens lack gradients and the randomness of dropout.
        """
        if (
            torch.is_grad_enabled()
            or any(module.training for module in self._mode_dependent)
            or is_recorded(window)
            or (weights := self._weights.state()) is None
        ):
            return None
        device = window.device.type
        return (
            weights,
            window.shape,
            window.dtype,
            window.device,
            # Tokens computed in another mode are not interchangeable.
            torch.is_inference_mode_enabled(),
            torch.is_autocast_enabled(device) and torch.get_autocast_dtype(device),
        )


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


@dataclass
class _Kept:
    """The last K - 1 frames and their tokens, and the conditions under which they can be reused."""

    conditions: tuple[object, ...]
    weights: list[Tensor]  # kept alive, because the conditions hold their ids
    frames: Tensor  # [N, K - 1, entries]
    tokens: Tensor  # float [N, K - 1, *token_shape]


def _as_words(frames: Tensor) -> Tensor:
    """Views frames [N, K, entries] as int64 if they fit: images compare five times faster."""
    frames = frames.detach().contiguous()
    size = frames.element_size()
    if frames.shape[-1] * size % 8 or frames.storage_offset() * size % 8:
        return frames
    return frames.view(torch.int64)
