"""History encoders that stack the frames as channels."""

from __future__ import annotations

from torch import Tensor

from torchrl_tit import settings
from torchrl_tit.frames.inner import InnerTransformer
from torchrl_tit.histories.encoder import HistoryEncoder, HistoryShape
from torchrl_tit.layers.images import ConvolutionalTorso, as_images


class StackedInnerTransformer(HistoryEncoder):
    """Inner blocks over K frames stacked as channels: the ablation "w/o Outer".

    Args:
        settings: patch size, width, blocks and outputs.
        shape: shape of the input, which must be flat frames.

    Raises:
        ValueError: if it gets tokens instead, the patch does not fit the observation, or the heads
            do not divide the width.

    Example:
        >>> import torch
        >>> shape = HistoryShape(num_frames=4, num_tokens=1, width=7056, frame_shape=(84, 84))
        >>> stacked = StackedInnerTransformer(settings.StackedInner(patch_size=12), shape)
        >>> stacked(torch.zeros(2, 4, 1, 7056, dtype=torch.uint8)).shape
        torch.Size([2, 64])
    """

    reads_frames = True

    def __init__(self, settings: settings.StackedInner, shape: HistoryShape) -> None:
        tokens = settings.num_blocks if settings.every_block else 1
        super().__init__(shape, out_features=tokens * settings.embed_dim)
        self.frame_shape = shape.require_frames(type(self).__name__)
        self.inner = InnerTransformer(settings, self.frame_shape, num_frames=shape.num_frames)

    def forward(self, tokens: Tensor) -> Tensor:
        """[..., K, 1, entries], float or uint8 -> class tokens of L blocks, float [..., L * D]."""
        return self.inner(self._frames(tokens)).flatten(-2)

    def _frames(self, tokens: Tensor) -> Tensor:
        """[..., K, 1, entries] -> [..., K, *frame_shape]."""
        return tokens.squeeze(-2).unflatten(-1, self.frame_shape)


class StackedCNN(HistoryEncoder):
    """A convolutional network on K images stacked as channels.

    Args:
        settings: which convolutions.
        shape: shape of the input, which must be flat frames of at least 36 pixels per side (resnet:
            8).

    Raises:
        ValueError: if it gets tokens instead, or frames are not images of that size.

    Example:
        >>> import torch
        >>> shape = HistoryShape(num_frames=4, num_tokens=1, width=7056, frame_shape=(84, 84))
        >>> cnn = StackedCNN(settings.StackedCNN(), shape)
        >>> cnn(torch.zeros(2, 4, 1, 7056, dtype=torch.uint8)).shape
        torch.Size([2, 3136])
    """

    reads_frames = True

    def __init__(self, settings: settings.StackedCNN, shape: HistoryShape) -> None:
        frame_shape = shape.require_frames(type(self).__name__)
        torso = ConvolutionalTorso(settings.torso, frame_shape, shape.num_frames)
        super().__init__(shape, out_features=torso.out_features)
        self.torso = torso
        self.frame_shape = frame_shape

    def forward(self, tokens: Tensor) -> Tensor:
        """[..., K, 1, entries], float or uint8 -> float [..., E]."""
        frames = tokens.unflatten(-1, self.frame_shape)  # [..., K, 1, (C,) H, W]
        images, leading = as_images(frames, len(self.frame_shape) + 2)
        return self.torso(images).reshape(*leading, self.out_features)
