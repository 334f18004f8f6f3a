"""Keeps the tokens of the last frames, so that acting encodes only the newest one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.modules.dropout import _DropoutNd

from torchrl_tit.modules.same_bytes import all_same, as_words, same_frames
from torchrl_tit.modules.sliding_window import SlidingWindow

Encode = Callable[[Tensor], Tensor]


@dataclass
class _Kept:
    """The last K - 1 frames and their tokens, and the conditions under which they can be reused."""

    conditions: tuple[object, ...]
    weights: list[Tensor]  # kept alive, because the conditions hold their ids
    words: SlidingWindow  # bytes of the frames, int [N, K - 1, words]
    tokens: SlidingWindow  # float [N, K - 1, *token_shape]


class FrameCache:
    """Encodes windows of K frames, and reuses the tokens of the frames of the previous call.

    A frame's tokens depend on that frame alone. While acting, each step's window is the previous
    step's window, moved by one frame, so K - 1 of its frames have already been encoded.

    Any windows are allowed. Tokens are reused only if the frame has the same bytes as the one they
    were computed from, in the same row of the batch, one place later in the window. All other
    frames are encoded; a frame that occurs several times is encoded once. So the first window of an
    episode, padded with copies of one observation or with zeros, costs one or two frames. The
    output is that of the encoder, up to rounding: the last bits may differ between a frame encoded
    alone and in a batch.

    Tokens are kept while each parameter and buffer of the encoder is the same tensor of the same
    version, PyTorch's count of writes. So a loaded state dict, ``to_module``, ``copy_`` and most
    optimizers are noticed. Writes through ``.data``, through shared memory and by fused optimizers
    leave no trace, and modules that replace others are not looked for: call :meth:`clear`
    afterwards, or the previous frames keep the tokens of the old weights.

    Nothing is kept or reused while gradients are enabled, dropout or batch normalisation is active
    in the encoder, ``to_module`` has put tensors in the place of parameters, under ``vmap`` and the
    other transforms of ``torch.func``, or while ``torch.compile``, ``torch.export`` or a CUDA graph
    is recording.

    Args:
        encoder: maps observations [..., *observation_shape] to tokens [..., *token_shape], each
            independently of the others; its only randomness is ``nn.Dropout``.
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
        modules = list(encoder.modules())
        # All modules that behave differently in training mode.
        self._mode_dependent = [
            module
            for module in modules
            if isinstance(module, _BatchNorm) or (isinstance(module, _DropoutNd) and module.p > 0)
        ]
        # Looked up at every step, for which named_parameters() takes too long.
        self._weights = [
            x for module in modules for x in (module._parameters, module._buffers) if x
        ]
        self._number_of_weights = len(self._present_weights())
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
        if self._must_bypass(window):
            return self.encoder(window)
        weights = self._present_weights()
        versions = _versions(weights)
        if len(weights) != self._number_of_weights or versions is None:
            return self.encoder(window)  # a later change of the weights would leave no trace
        device = window.device.type
        conditions = (
            *map(id, weights),
            *versions,
            window.shape,
            window.dtype,
            window.device,
            # Tokens computed in another mode are not interchangeable.
            torch.is_inference_mode_enabled(),
            torch.is_autocast_enabled(device) and torch.get_autocast_dtype(device),
        )
        kept = self._kept if self._kept and self._kept.conditions == conditions else None
        leading = window.shape[: window.ndim - self._observation_ndim - 1]
        frames = window.reshape(math.prod(leading), *window.shape[len(leading) :])  # [N, K, *obs]
        words = as_words(frames.flatten(2))  # [N, K, words]
        newest = self._encode_newest(frames[:, -1]).unsqueeze(1)  # [N, 1, *token_shape]
        if kept and all_same(words[:, :-1], kept.words.entries):
            tokens = torch.cat([kept.tokens.entries, newest], dim=1)
            kept.words.append(words[:, -1])
            kept.tokens.append(newest[:, 0])
        else:
            tokens = torch.cat([self._encode_older(frames, words, newest, kept), newest], dim=1)
            self._kept = _Kept(
                conditions, weights, SlidingWindow(words[:, 1:]), SlidingWindow(tokens[:, 1:])
            )
        return tokens.reshape(*leading, *tokens.shape[1:])

    def _encode_older(
        self, frames: Tensor, words: Tensor, newest: Tensor, kept: _Kept | None
    ) -> Tensor:
        """Tokens of all frames but the newest, [N, K - 1, *token_shape]; some are known."""
        older = words[:, :-1]
        unknown = ~same_frames(older, words[:, -1:])
        tokens = newest.repeat(1, older.shape[1], *[1] * (newest.ndim - 2))
        if kept is not None:
            known = same_frames(older, kept.words.entries)
            tokens[known] = kept.tokens.entries[known]
            unknown &= ~known
        if unknown.any():
            distinct, index = older[unknown].unique(dim=0, return_inverse=True)
            distinct = distinct.view(frames.dtype).unflatten(-1, frames.shape[2:])
            tokens[unknown] = self.encoder(distinct)[index]
        return tokens

    def _present_weights(self) -> list[Tensor]:
        """The parameters and buffers of the encoder, without those that to_module has replaced."""
        return [x for tensors in self._weights for x in tensors.values() if x is not None]

    def _must_bypass(self, window: Tensor) -> bool:
        """Whether reused tokens would lack gradients or randomness, or cannot be compared."""
        return (
            torch.is_grad_enabled()
            or any(module.training for module in self._mode_dependent)
            or torch.compiler.is_compiling()
            or torch.jit.is_tracing()
            or type(window) is not Tensor  # a fake tensor, during tracing
            or window.is_meta
            or forward_ad._current_level >= 0
            or torch._C._functorch.peek_interpreter_stack() is not None  # vmap, jvp, ...
            or (window.is_cuda and torch.cuda.is_current_stream_capturing())
        )


def _versions(tensors: list[Tensor]) -> list[int] | None:
    """How often each tensor has been written, as PyTorch counts for autograd."""
    try:
        return [tensor._version for tensor in tensors]
    except RuntimeError:  # not counted, for tensors of inference mode
        return None
