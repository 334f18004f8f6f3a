"""Convolutional frame encoders, which map one image to one token."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from torch import Tensor, nn

from torchrl_tit import settings
from torchrl_tit.frames.encoder import FrameEncoder
from torchrl_tit.frames.observation import Kind
from torchrl_tit.layers.images import ConvolutionalTorso, as_images


class CNNFrameEncoder(FrameEncoder):
    """Maps one image to one token: convolutions and a linear layer.

    With the residual network of arXiv 2212.14538, this is the frame encoder of Catformer and
    CoBERL.

    Args:
        settings: which convolutions, and the width of the token.
        observation_shape: (H, W) or (C, H, W), at least 8 pixels per side (NatureCNN: 36).

    Raises:
        ValueError: if observations are not images of that size.

    Example:
        >>> import torch
        >>> encoder = CNNFrameEncoder(settings.ResNetFrames(embed_dim=255), (84, 84))
        >>> encoder(torch.zeros(2, 4, 84, 84)).shape
        torch.Size([2, 4, 1, 255])
    """

    kinds: ClassVar[tuple[Kind, ...]] = ("image",)

    def __init__(
        self,
        settings: settings.ResNetFrames | settings.NatureCNNFrames,
        observation_shape: Sequence[int],
    ) -> None:
        super().__init__(observation_shape, num_tokens=1, width=settings.embed_dim)
        self.torso = ConvolutionalTorso(settings.name, self.observation_shape)
        self.linear = nn.Linear(self.torso.out_features, settings.embed_dim)

    def forward(self, observation: Tensor) -> Tensor:
        """[..., (C,) H, W], float or uint8 -> float [..., 1, D]."""
        images, leading = as_images(observation, len(self.observation_shape))
        return self.linear(self.torso(images)).reshape(*leading, 1, self.width)
