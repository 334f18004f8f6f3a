"""The contract of history encoders."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

from torchrl_tit.layers.attention import attention_maps
from torchrl_tit.windows import Windows

State = dict[str, Tensor]
"""The state of a recurrent encoder: its entries by key, [*B, ...] each."""


@dataclass(frozen=True)
class HistoryShape:
    """The input of a history encoder."""

    num_frames: int
    """Number K of frames."""
    num_tokens: int
    """Number L of tokens per frame."""
    width: int
    """Width D of a token."""
    frame_shape: tuple[int, ...] | None = None
    """The observation's shape, if the token is the observation itself; for categories, the shape of
    their one-hot vectors."""
    action_dim: int | None = None
    """Entries of a continuous action, or number of discrete ones, if the task is known."""

    def require_frames(self, reader: str) -> tuple[int, ...]:
        """Returns the observation's shape, for history encoders that read the frames themselves.

        Args:
            reader: name of the history encoder.

        Raises:
            ValueError: if the tokens are not the frames themselves.
        """
        if self.frame_shape is None:
            raise ValueError(
                f"{reader} stacks the frames themselves, not tokens: choose flat frames of one "
                "observation, or another history encoder"
            )
        return self.frame_shape


class HistoryEncoder(nn.Module):
    """Turns the tokens of the last K frames into one vector.

    A subclass is built as ``Encoder(settings, shape)``, calls ``super().__init__`` with the size of
    its output, and implements ``forward``.

    Args:
        shape: shape of the input.
        out_features: size E of the output.

    Raises:
        ValueError: if the encoder reads the frames themselves, but gets tokens.
    """

    reads_frames: ClassVar[bool] = False
    """Whether it reads the frames themselves (see :class:`~torchrl_tit.frames.flat.Flat`), also as
    uint8."""
    context: ClassVar[tuple[str, ...]] = ()
    """Names of its inputs besides the tokens, one argument of ``forward`` each."""
    reads_any_length: ClassVar[bool] = False
    """Whether it accepts histories of any length, not only ``num_frames``."""
    encodes_every_frame: ClassVar[bool] = False
    """Whether ``every_frame`` is implemented."""
    is_recurrent: ClassVar[bool] = False
    """Whether it can carry a state from step to step: a :class:`RecurrentEncoder`."""

    def __init__(self, shape: HistoryShape, *, out_features: int) -> None:
        super().__init__()
        if self.reads_frames:
            shape.require_frames(type(self).__name__)
        self.shape = shape
        self.out_features = out_features

    def forward(self, tokens: Tensor) -> Tensor:
        """Encodes histories.

        Args:
            tokens: float [..., K, L, D], the oldest frame first.

        Returns:
            float [..., E].
        """
        raise NotImplementedError("there is no forward, which maps [..., K, L, D] to [..., E]")

    def every_frame(self, tokens: Tensor, *context: Tensor) -> Tensor:
        """Encodes every frame from itself and the frames before it, for losses on whole windows.

        Args:
            tokens: as in ``forward``.
            *context: its other inputs, as in ``forward``.

        Returns:
            float [..., K, E].
        """
        raise NotImplementedError

    def reads_tables(self, windows: Windows) -> bool:
        """Whether ``read_table`` is implemented, and faster for these windows than ``forward``."""
        return False

    def read_table(self, tokens: Tensor, windows: Windows) -> Tensor:
        """Encodes windows on a table of frames, without a copy of each window.

        Args:
            tokens: float [R, L, D], of each frame.
            windows: rows of the frames, [N, T, K], none missing.

        Returns:
            float [N, T, E]: that of ``forward(windows.gather(tokens))``.
        """
        raise NotImplementedError

    def attention_maps(self, tokens: Tensor, *context: Tensor) -> list[Tensor]:
        """Returns the attention weights of each attention layer of this library in it.

        Args:
            tokens: as in ``forward``.
            *context: as in ``forward``.

        Returns:
            float [..., heads, K, K] of each layer, in the order of their calls.
        """
        maps = attention_maps(self, tokens, *context)
        return [weights.reshape(*tokens.shape[:-3], *weights.shape[-3:]) for weights in maps]


class RecurrentEncoder(HistoryEncoder):
    """A history encoder with a state.

    If it reads one frame (K = 1), :class:`~torchrl_tit.modules.Backbone` carries the state from
    step to step in the tensordict. If it reads several, the state is zero at the start of each
    history.
    """

    is_recurrent = True
    state_shapes: dict[str, torch.Size]
    """Shape of each entry of the state, without batch dimensions."""

    def step(self, tokens: Tensor, state: State, is_init: Tensor) -> tuple[Tensor, State]:
        """Reads single steps, or whole sequences within ``torchrl.modules.set_recurrent_mode``.

        Args:
            tokens: float [*B, L, D]; in recurrent mode the last dimension of B is time.
            state: the state before each step, [*B, *state_shape] each; in a sequence, it is read
                only at the first step and wherever an episode begins.
            is_init: bool [*B, 1], True where an episode begins.

        Returns:
            float [*B, E], and the state after each step; in a sequence, only that of its last step
            need be right.
        """
        raise NotImplementedError

    def single_step(self, tokens: Tensor, state: State, is_init: Tensor) -> tuple[Tensor, State]:
        """Like :meth:`step` on single steps, in a form that `torch.export` can trace."""
        return self.step(tokens, state, is_init)


class OneToken(nn.Module):
    """Merges the L tokens of a frame into one with a linear layer; does nothing if L = 1.

    Args:
        shape: input shape of the history encoder.

    Example:
        >>> shape = HistoryShape(num_frames=4, num_tokens=2, width=32)
        >>> OneToken(shape)(torch.rand(8, 4, 2, 32)).shape
        torch.Size([8, 4, 32])
    """

    def __init__(self, shape: HistoryShape) -> None:
        super().__init__()
        inputs = shape.num_tokens * shape.width
        self.linear = nn.Linear(inputs, shape.width) if shape.num_tokens > 1 else nn.Identity()

    def forward(self, tokens: Tensor) -> Tensor:
        """Float [..., L, D] -> float [..., D]."""
        return self.linear(tokens.flatten(-2))
