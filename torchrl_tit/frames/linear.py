"""A linear layer on the whole observation."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

from torch import Tensor, nn

from torchrl_tit import settings
from torchrl_tit.frames.encoder import FrameEncoder
from torchrl_tit.frames.observation import Kind
from torchrl_tit.layers.activations import make_activation
from torchrl_tit.layers.categories import CategoryIndex
from torchrl_tit.layers.patches import embed


class LinearFrameEncoder(FrameEncoder):
    """Maps an observation to one token with a linear layer; categories become one-hot vectors.

    This is the observation embedding of the ablation without inner blocks (arXiv 2212.14538,
    appendix "Ablation Study"); with a bias, it is that of Decision Transformer.

    Args:
        settings: width, bias and activation.
        observation_shape: (D,) for arrays and categories, (H, W) or (C, H, W) for images.
        categories: for categories, the number of values of each entry.

    Example:
        >>> import torch
        >>> encoder = LinearFrameEncoder(settings.Linear(embed_dim=32), (84, 84))
        >>> encoder(torch.zeros(8, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([8, 4, 1, 32])
    """

    kinds: ClassVar[tuple[Kind, ...]] = ("array", "image", "categories")

    def __init__(
        self,
        settings: settings.Linear,
        observation_shape: Sequence[int],
        *,
        categories: Sequence[int] | None = None,
    ) -> None:
        super().__init__(observation_shape, num_tokens=1, width=settings.embed_dim)
        self.index = None if categories is None else CategoryIndex(categories)
        entries = math.prod(observation_shape) if categories is None else sum(categories)
        self.linear = nn.Linear(entries, settings.embed_dim, bias=settings.bias)
        self.activation: nn.Module = nn.Identity()
        if settings.activation != "none":
            self.activation = make_activation(settings.activation)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initializes the weights of categories. Others are those of the linear layer."""
        if self.index is not None:  # as many inputs are 1 as there are entries
            bound = 1 / math.sqrt(len(self.index.first))
            nn.init.uniform_(self.linear.weight, -bound, bound)

    def forward(self, observation: Tensor) -> Tensor:
        """[..., *observation_shape], float, uint8 or categories -> float [..., 1, D]."""
        if self.index is None:
            x = observation.flatten(-len(self.observation_shape)).unsqueeze(-2)  # [..., 1, entries]
            token = embed(x, self.linear.weight)
        else:  # for one-hot vectors, all other products are zero
            weights = self.index.embed(observation, self.linear.weight.t())
            token = weights.sum(-2, keepdim=True)
        return self.activation(token if self.linear.bias is None else token + self.linear.bias)
