"""Tokens of the frames that were just seen, so that acting encodes only the newest one."""

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

from torchrl_tit.modules.frames import all_same, as_words, same_frames
from torchrl_tit.modules.shelf import Shelf
from torchrl_tit.modules.weights import WeightCopies, modules_within, weights_within

Encode = Callable[[Tensor], Tensor]


@dataclass
class _Kept:
    """What is kept of a window, and what must not have changed for it to be of use."""

    weights: WeightCopies  # of the encoder that made the tokens
    circumstances: tuple[object, ...]
    words: Shelf  # of the last K - 1 frames, int [N, K - 1, words]
    tokens: Shelf  # of the same, float [N, K - 1, *token_shape]


class FrameCache:
    """Encodes the frames of a window of K steps, those it saw a step ago from memory.

    A frame's tokens depend on that frame alone. While acting, the window of a step is that of the
    step before, moved by one: K - 1 of its frames were encoded then.

    What comes out is what the encoder would put out, within rounding (a frame encoded alone and
    within a batch differ in the last bits), because nothing is taken on trust:

    - A frame's tokens are reused if the frame has the same bytes as the one that they were made of,
      which stood one step later in the window and in the same place of the batch. Bytes are
      compared, not numbers: the same bytes give the same tokens whatever they mean, NaN and
      negative zeros too.
    - All weights and buffers of the encoder are compared with copies of those that made the tokens,
      at each call.

    All else is encoded, a frame that repeats within its window once: so the first window of an
    episode, which starts with copies of one observation or of zeros, costs a frame or two.

    Nothing is kept or reused where gradients are asked for, dropout or batch normalisation is
    active in the encoder, under ``vmap`` and the other transforms of ``torch.func``, and while
    ``torch.compile``, ``torch.export`` or a CUDA graph record. Copies and pickles are empty.

    Args:
        encoder: maps observations [..., *observation_shape] to tokens [..., *token_shape], each by
            itself; what it draws at random, it draws in ``nn.Dropout``.
        observation_ndim: number of axes of an observation.
        encode_newest: encodes the newest frame of each window: the encoder itself where not given,
            or the encoder compiled.

    Example:
        >>> from torchrl_tit import EnhancedTIT
        >>> tit = EnhancedTIT(observation_shape=(4,), history=8)
        >>> cache = FrameCache(tit.frame_encoder, observation_ndim=1)
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
        self._encoder = encoder
        self._observation_ndim = observation_ndim
        self._encode_newest = encoder if encode_newest is None else encode_newest
        self._kept: _Kept | None = None

    def clear(self) -> None:
        """Forgets everything, so that the next window is encoded as a first one is."""
        self._kept = None

    def __call__(self, window: Tensor) -> Tensor:
        """Encodes windows.

        Args:
            window: [..., K, *observation_shape], oldest first.

        Returns:
            float [..., K, *token_shape].
        """
        kept = self._kept
        modules = modules_within(self._encoder)
        if _must_bypass(window, modules):
            return self._encoder(window)
        device = window.device.type
        circumstances = (
            window.shape,
            window.dtype,
            window.device,
            # Tokens that were made under these are of another kind.
            torch.is_inference_mode_enabled(),
            torch.is_autocast_enabled(device) and torch.get_autocast_dtype(device),
        )
        if kept and not (circumstances == kept.circumstances and kept.weights.hold(modules)):
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

        # Copied before the encoder runs: if another process writes meanwhile, it is noticed next.
        weights = kept.weights if kept else WeightCopies(modules)
        newest = self._encode_newest(frames[:, -1]).unsqueeze(1)
        tokens = self._encode_unknown(frames, words, newest, kept)
        self._kept = _Kept(weights, circumstances, Shelf(words[:, 1:]), Shelf(tokens[:, 1:]))
        return tokens.reshape(*leading, *tokens.shape[1:])

    def _encode_unknown(
        self, frames: Tensor, words: Tensor, newest: Tensor, kept: _Kept | None
    ) -> Tensor:
        """Tokens [N, K, *token_shape] of frames of which only the newest are encoded."""
        repeated = same_frames(words[:, :-1], words[:, 1:])  # by the next step, [N, K - 1]
        if kept is None:
            known = torch.zeros_like(repeated)
            older = newest.expand(-1, repeated.shape[1], *newest.shape[2:])
        else:
            known = same_frames(words[:, :-1], kept.words.entries)
            older = kept.tokens.entries
        tokens = torch.cat([older, newest], dim=1)
        unknown = ~known & ~repeated
        if unknown.any():
            tokens[:, :-1][unknown] = self._encoder(frames[:, :-1][unknown])
        # A frame that repeats takes its tokens from the first later step that has some.
        steps = torch.arange(frames.shape[1], device=frames.device)
        last = steps[-1]
        source = torch.where(repeated & ~known, last, steps[:-1])  # [N, K - 1]
        source = source.flip(1).cummin(1).values.flip(1)
        rows = torch.arange(len(frames), device=frames.device).unsqueeze(1)
        return torch.cat([tokens[rows, source], newest], dim=1)

    def __getstate__(self) -> dict[str, Any]:
        return {"encoder": self._encoder, "observation_ndim": self._observation_ndim}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]


def _must_bypass(window: Tensor, modules: Sequence[nn.Module]) -> bool:
    """Whether kept tokens would lack gradients, randomness, or values to compare."""
    return (
        torch.compiler.is_compiling()
        or torch.jit.is_tracing()
        or type(window) is not Tensor  # a stand-in for one, while something is traced
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
    """Whether a module is one that puts out other values in training mode, and is in it."""
    if not module.training:
        return False
    return isinstance(module, _BatchNorm) or (isinstance(module, _DropoutNd) and module.p > 0)
