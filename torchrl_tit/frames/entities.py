"""A transformer on a set of entities, whose number varies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import ClassVar

import torch
from torch import Tensor

from torchrl_tit import settings
from torchrl_tit.frames.encoder import FrameEncoder
from torchrl_tit.frames.inner import InnerTransformer
from torchrl_tit.frames.observation import Kind, check_observation_shape
from torchrl_tit.layers.images import bytes_to_floats


class EntityTransformer(FrameEncoder):
    """Reads a set of entities with an inner transformer, in which each entity is a token.

    An observation has a row of D entries for each of at most N entities. The last entry of a row is
    the mask: above 0 where there is an entity, 0 or less where the row is padding. Numbers in
    padding are never read, NaN neither, and how many rows of padding there are, and the order of
    the rows, make no difference. There are no position encodings. An entity's token is a linear
    function of its entries, with a bias. Without entities, the class token stands alone.

    That networks read sets as they are was shown by Deep Sets (arXiv 1703.06114), and with
    attention by the Set Transformer (arXiv 1810.00825).

    Args:
        settings: width, blocks and outputs.
        observation_shape: (N, D).

    Raises:
        ValueError: if the observation has another shape, or the heads do not divide the width.

    Example:
        >>> encoder = EntityTransformer(settings.Entities(), (5, 3))
        >>> entities = torch.randn(8, 2, 3)  # the last entry is the mask
        >>> entities[..., -1] = 1
        >>> padding = torch.cat([torch.randn(8, 3, 2), torch.zeros(8, 3, 1)], -1)
        >>> tokens = encoder(torch.cat([entities, padding], 1))
        >>> tokens.shape
        torch.Size([8, 2, 32])
        >>> torch.allclose(tokens, encoder(torch.cat([100 * padding, entities], 1)), atol=1e-5)
        True
    """

    kinds: ClassVar[tuple[Kind, ...]] = ("image",)
    reads_entities = True

    def __init__(self, settings: settings.Entities, observation_shape: Sequence[int]) -> None:
        shape = check_observation_shape(observation_shape)
        if len(shape) != 2 or shape[1] < 2:
            raise ValueError(
                f"entities frames read observations (N, D), N rows of D entries, of which the last "
                f"is the mask, not {shape}"
            )
        inner = _inner_of(settings, shape)
        super().__init__(shape, num_tokens=inner.num_tokens, width=inner.width)
        self.inner = inner

    def forward(self, observation: Tensor) -> Tensor:
        """Encodes sets.

        Args:
            observation: [..., N, D], float or uint8.

        Returns:
            Class tokens, float [..., L, width], or [..., 1, width] of the last block only.
        """
        x = self.clean(observation)
        return self.inner(x.flatten(-2), x[..., -1] > 0)

    def clean(self, observation: Tensor) -> Tensor:
        """Writes zeros into padding, and a mask of 0 and 1; [..., N, D] -> float [..., N, D]."""
        x = bytes_to_floats(observation, self.inner.class_token.dtype)
        present = x[..., -1:] > 0
        return torch.cat([x[..., :-1].masked_fill(~present, 0), present.to(x.dtype)], -1)

    def samples(self, observations: Tensor) -> Tensor:
        """Returns the rows of all entities, [..., N, D] -> [M, D]."""
        return observations[observations[..., -1] > 0]


def _inner_of(entities: settings.Entities, shape: tuple[int, ...]) -> InnerTransformer:
    """An inner transformer whose patches are the rows.

    All patches share one embedding. The mask, which is 1 in all rows that are read, is its bias.
    """
    inner = settings.Inner(patch_size=shape[1], position_encoding=False, **asdict(entities))
    return InnerTransformer(inner, (math.prod(shape),))
