"""The observation itself as a token."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

from torch import Tensor

from torchrl_tit import settings
from torchrl_tit.frames.encoder import FrameEncoder
from torchrl_tit.frames.observation import Kind, check_observation_shape
from torchrl_tit.layers.categories import CategoryIndex


class Flat(FrameEncoder):
    """Flattens an observation into a single token that holds all of its entries.

    For history encoders that stack frames. Images stay uint8, categories become one-hot vectors.

    Args:
        settings: the settings, which have no fields.
        observation_shape: (D,) for arrays and categories, (H, W) or (C, H, W) for images.
        categories: for categories, the number of values of each entry.

    Example:
        >>> import torch
        >>> Flat(settings.Flat(), (84, 84))(torch.zeros(8, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([8, 4, 1, 7056])
    """

    kinds: ClassVar[tuple[Kind, ...]] = ("array", "image", "categories")

    def __init__(
        self,
        settings: settings.Flat,
        observation_shape: Sequence[int],
        *,
        categories: Sequence[int] | None = None,
    ) -> None:
        shape = check_observation_shape(observation_shape)
        entries = math.prod(shape) if categories is None else sum(categories)
        super().__init__(shape, num_tokens=1, width=entries)
        self.index = None if categories is None else CategoryIndex(categories)

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """Shape of the frames, as tokens: the observation's, or that of one-hot vectors."""
        return self.observation_shape if self.index is None else (self.width,)

    def forward(self, observation: Tensor) -> Tensor:
        """Flattens observations.

        Args:
            observation: [..., *observation_shape] of any dtype.

        Returns:
            [..., 1, entries] of the same dtype; bool for categories.
        """
        if self.index is not None:
            return self.index.one_hot(observation).unsqueeze(-2)
        return observation.flatten(-len(self.observation_shape)).unsqueeze(-2)
