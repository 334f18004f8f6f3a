"""Dropout that draws its mask faster on a CPU."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchrl_tit.settings.arguments import checked_arguments
from torchrl_tit.settings.numbers import Fraction

_INT64 = torch.iinfo(torch.int64)
_LEVELS = 2**16
"""Number of values of 16 random bits; p is rounded to a multiple of its inverse."""


class Dropout(nn.Dropout):
    """Dropout (Srivastava et al. 2014), with the distribution of :class:`torch.nn.Dropout`.

    On a CPU, ``nn.Dropout`` draws a number for each entry, one after another, which took a sixth of
    a training step of Decision Transformer. This module draws one 64-bit number for every four
    entries, in a fifth of that time. On other devices it is ``nn.Dropout``, whose kernels are
    fused.

    Args:
        p: probability of a zero; on a CPU rounded to the nearest 1/65536, also for the scale.

    Example:
        >>> dropout = Dropout(0.25)
        >>> sorted(dropout(torch.ones(1000)).unique().tolist())
        [0.0, 1.3333333730697632]
        >>> dropout.eval()(torch.ones(2))
        tensor([1., 1.])
    """

    @checked_arguments
    def __init__(self, p: Fraction = 0.5) -> None:
        super().__init__(p)

    def forward(self, input: Tensor) -> Tensor:
        """Zeroes entries with probability p while training and scales the others by 1 / (1 - p)."""
        if not self.training or self.p in (0, 1) or input.device.type != "cpu":
            return super().forward(input)
        dropped = min(round(self.p * _LEVELS), _LEVELS - 1)
        draws = torch.randint(_INT64.min, _INT64.max, (math.ceil(input.numel() / 4),))
        bits = draws.view(torch.int16)[: input.numel()].view(input.shape)  # from -2^15 on
        # Floats throughout: comparing integers and converting booleans to numbers takes longer.
        scale = bits.float().ge_(dropped - _LEVELS // 2).mul_(_LEVELS / (_LEVELS - dropped))
        return input * scale.to(input.dtype)  # 0 or 1 / (1 - p)
