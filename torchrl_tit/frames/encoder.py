"""The contract of frame encoders."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn


class FrameEncoder(nn.Module):
    """Turns one observation into tokens, the same way at every step.

    A frame's tokens depend on that frame alone. So while acting, and in training on consecutive
    steps, each frame is encoded once, however many histories it is part of.

    A subclass is built as ``Encoder(settings, observation_shape)``, calls ``super().__init__`` with
    the shapes of its input and output, and implements ``forward``.

    Args:
        observation_shape: (D,) for arrays, (H, W) or (C, H, W) for images.
        num_tokens: number L of tokens that an observation becomes.
        width: width D of a token.

    Raises:
        ValueError: if the observation is neither an array nor an image.
    """

    num_tokens: int
    """Number L of tokens of an observation."""
    width: int
    """Width D of a token."""

    def __init__(self, observation_shape: Sequence[int], *, num_tokens: int, width: int) -> None:
        super().__init__()
        self.observation_shape = check_observation_shape(observation_shape)
        self.num_tokens = num_tokens
        self.width = width

    def forward(self, observation: Tensor) -> Tensor:
        """Encodes observations.

        Args:
            observation: [..., *observation_shape], float, or uint8, which is scaled to 0..1.

        Returns:
            float [..., L, D].
        """
        raise NotImplementedError

    def attention_maps(self, observation: Tensor) -> list[Tensor]:
        """Returns the attention weights of each block, float [..., heads, S, S]; default: none."""
        return []


def check_observation_shape(shape: Sequence[int]) -> tuple[int, ...]:
    """Returns the shape of an observation as a tuple.

    Raises:
        ValueError: if it is neither the shape of an array nor that of an image.
    """
    if not isinstance(shape, Sequence) or len(shape) not in (1, 2, 3) or min(shape) < 1:
        raise ValueError(
            f"observation_shape {shape!r} is not that of an array (D,) or an image (H, W) or "
            "(C, H, W)"
        )
    return tuple(shape)


def check_image_shape(shape: Sequence[int], smallest: int) -> tuple[int, ...]:
    """Returns the shape of an image as a tuple.

    Raises:
        ValueError: if it is the shape of an array, or has fewer than ``smallest`` pixels a side.
    """
    shape = check_observation_shape(shape)
    if len(shape) == 1:
        raise ValueError(
            f"observation_shape {shape} is that of an array, but this encoder reads images (H, W) "
            "or (C, H, W): for arrays take inner or linear frames, or stack them for an mlp"
        )
    if min(shape[-2:]) < smallest:
        raise ValueError(
            f"images of {shape[-2]} x {shape[-1]} pixels are too small for these convolutions: "
            f"both sides must have at least {smallest}"
        )
    return shape
