"""Keeps the tokens of the last frames, so that acting encodes only the newest one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.modules.dropout import _DropoutNd

from torchrl_tit.modules.same_bytes import all_same, as_words, same_frames
from torchrl_tit.modules.sliding_window import SlidingWindow
from torchrl_tit.modules.weight_copies import WeightCopies, modules_within, weights_within

Encode = Callable[[Tensor], Tensor]


@dataclass
class _Kept:
    """The last K - 1 frames and their tokens, and the conditions under which they can be reused."""

    weights: WeightCopies  # of the encoder that computed the tokens
    conditions: tuple[object, ...]
    words: SlidingWindow  # bytes of the frames, int [N, K - 1, words]
    tokens: SlidingWindow  # float [N, K - 1, *token_shape]


class FrameCache:
    """Encodes windows of K frames, and reuses the tokens of the frames of the previous call.

    A frame's tokens depend on that frame alone. While acting, the window of a step is that of the
    step before, moved by one frame, so K - 1 of its frames have been encoded already.

    The output is that of the encoder, within rounding (a frame encoded alone and in a batch may
    differ in the last bits), because nothing is taken on trust:

    - Tokens are reused only if the frame has the same bytes as the one they were computed from,
      which was in the same row of the batch, one place later in the window. Bytes are compared, not
      numbers: equal bytes have equal tokens, even NaN and negative zero.
    - At each call, all weights and buffers of the encoder are compared with copies of those that
      computed the tokens.

    Everything else is encoded; a frame that repeats within its window, once. So the first window of
    an episode, padded with copies of one observation or with zeros, costs one or two frames.

    Nothing is kept or reused while gradients are required, dropout or batch normalisation is active
    in the encoder, under ``vmap`` and the other transforms of ``torch.func``, or while
    ``torch.compile``, ``torch.export`` or a CUDA graph is recording. Copies and pickles are empty.

    Args:
        encoder: maps observations [..., *observation_shape] to tokens [..., *token_shape], each one
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
        kept = self._kept
        modules = modules_within(self.encoder)
        if _must_bypass(window, modules):
            return self.encoder(window)
        device = window.device.type
        conditions = (
            window.shape,
            window.dtype,
            window.device,
            # Tokens computed in another mode are not interchangeable.
            torch.is_inference_mode_enabled(),
            torch.is_autocast_enabled(device) and torch.get_autocast_dtype(device),
        )
        if kept and not (conditions == kept.conditions and kept.weights.match(modules)):
            kept = None

        leading = window.shape[: window.ndim - self._observation_ndim - 1]
        frames = window.reshape(math.prod(leading), *window.shape[len(leading) :])  # [N, K, *obs]
        words = as_words(frames.flatten(2))  # [N, K, words]
        if kept and all_same(words[:, :-1], kept.words.entries):
            newest = self._encode_newest(frames[:, -1])  # [N, *token_shape]
            tokens = torch.cat([kept.tokens.entries, newest.unsqueeze(1)], dim=1)
            kept.words.append(words[:, -1])
            kept.tokens.append(newest)
            self._kept = kept
            return tokens.reshape(*leading, *tokens.shape[1:])

        # Copied before the encoder runs, so that concurrent writes are noticed at the next call.
        weights = kept.weights if kept else WeightCopies(modules)
        newest = self._encode_newest(frames[:, -1]).unsqueeze(1)
        tokens = self._encode_unknown(frames, words, newest, kept)
        self._kept = _Kept(
            weights, conditions, SlidingWindow(words[:, 1:]), SlidingWindow(tokens[:, 1:])
        )
        return tokens.reshape(*leading, *tokens.shape[1:])

    def _encode_unknown(
        self, frames: Tensor, words: Tensor, newest: Tensor, kept: _Kept | None
    ) -> Tensor:
        """Encodes the unknown frames; newest [N, 1, *token_shape] -> [N, K, *token_shape]."""
        repeated = same_frames(words[:, :-1], words[:, 1:])  # equal to the next frame, [N, K - 1]
        if kept is None:
            known = torch.zeros_like(repeated)
            older = newest.expand(-1, repeated.shape[1], *newest.shape[2:])
        else:
            known = same_frames(words[:, :-1], kept.words.entries)
            older = kept.tokens.entries
        tokens = torch.cat([older, newest], dim=1)
        unknown = ~known & ~repeated
        if unknown.any():
            tokens[:, :-1][unknown] = self.encoder(frames[:, :-1][unknown])
        # A repeated frame has the tokens of the first later frame whose tokens are known.
        steps = torch.arange(frames.shape[1], device=frames.device)
        last = steps[-1]
        source = torch.where(repeated & ~known, last, steps[:-1])  # [N, K - 1]
        source = source.flip(1).cummin(1).values.flip(1)
        rows = torch.arange(len(frames), device=frames.device).unsqueeze(1)
        return torch.cat([tokens[rows, source], newest], dim=1)

    def __getstate__(self) -> dict[str, Any]:
        return {"encoder": self.encoder, "observation_ndim": self._observation_ndim}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]


def _must_bypass(window: Tensor, modules: Sequence[nn.Module]) -> bool:
    """Whether reused tokens would lack gradients or randomness, or values cannot be compared."""
    return (
        torch.compiler.is_compiling()
        or torch.jit.is_tracing()
        or type(window) is not Tensor  # a fake tensor, while something is traced
        or window.is_meta
        or (
            torch.is_grad_enabled()
            and any(x.requires_grad for x in (window, *weights_within(modules)))
        )
        or forward_ad._current_level >= 0
        or torch._C._functorch.peek_interpreter_stack() is not None  # vmap, jvp, ...
        or any(map(_depends_on_mode, modules))
        or (window.is_cuda and torch.cuda.is_current_stream_capturing())
    )


def _depends_on_mode(module: nn.Module) -> bool:
    """Whether a module is in training mode and its output depends on that."""
    if not module.training:
        return False
    return isinstance(module, _BatchNorm) or (isinstance(module, _DropoutNd) and module.p > 0)
