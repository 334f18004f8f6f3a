"""The observation itself as a token."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor

from torchrl_tit import settings
from torchrl_tit.frames.encoder import FrameEncoder, check_observation_shape


class Flat(FrameEncoder):
    """Flattens an observation into a single token that holds all of its entries.

    For history encoders that stack frames. Images stay uint8.

    Args:
        settings: the settings, which have no fields.
        observation_shape: (D,) for arrays, (H, W) or (C, H, W) for images.

    Example:
        >>> import torch
        >>> Flat(settings.Flat(), (84, 84))(torch.zeros(8, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([8, 4, 1, 7056])
    """

    def __init__(self, settings: settings.Flat, observation_shape: Sequence[int]) -> None:
        shape = check_observation_shape(observation_shape)
        super().__init__(shape, num_tokens=1, width=math.prod(shape))

    def forward(self, observation: Tensor) -> Tensor:
        """[..., *observation_shape] of any dtype -> [..., 1, entries] of the same."""
        return observation.flatten(-len(self.observation_shape)).unsqueeze(-2)
