"""A linear layer on the whole observation."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor, nn

from torchrl_tit import settings
from torchrl_tit.frames.encoder import FrameEncoder, check_observation_shape
from torchrl_tit.layers.activations import make_activation
from torchrl_tit.layers.patches import embed


class LinearFrameEncoder(FrameEncoder):
    """Maps a whole observation to one token with a linear layer.

    The observation embedding of the ablation without inner blocks (arXiv 2212.14538, appendix
    "Ablation Study"); with a bias, that of Decision Transformer.

    Args:
        settings: width, bias and activation.
        observation_shape: (D,) for arrays, (H, W) or (C, H, W) for images.

    Example:
        >>> import torch
        >>> encoder = LinearFrameEncoder(settings.Linear(embed_dim=32), (84, 84))
        >>> encoder(torch.zeros(8, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([8, 4, 1, 32])
    """

    def __init__(self, settings: settings.Linear, observation_shape: Sequence[int]) -> None:
        shape = check_observation_shape(observation_shape)
        super().__init__(shape, num_tokens=1, width=settings.embed_dim)
        self.linear = nn.Linear(math.prod(shape), settings.embed_dim, bias=settings.bias)
        self.activation: nn.Module = nn.Identity()
        if settings.activation != "none":
            self.activation = make_activation(settings.activation)

    def forward(self, observation: Tensor) -> Tensor:
        """[..., *observation_shape], float or uint8 -> float [..., 1, D]."""
        x = observation.flatten(-len(self.observation_shape)).unsqueeze(-2)  # [..., 1, entries]
        token = embed(x, self.linear.weight)
        return self.activation(token if self.linear.bias is None else token + self.linear.bias)
