"""Fully connected layers on all entries of all tokens: MLP, OFENet and D2RL."""

from __future__ import annotations

import math
from functools import partial

import torch
import torchrl.modules
from torch import Tensor, nn

from torchrl_tit import settings
from torchrl_tit.histories.encoder import HistoryEncoder, HistoryShape
from torchrl_tit.layers.activations import make_activation


class MLP(HistoryEncoder):
    """TorchRL's `MLP` on the entries of all tokens of K frames.

    Args:
        settings: width, layers and activation.
        shape: shape of the input.

    Example:
        >>> mlp = MLP(settings.MLP(), HistoryShape(num_frames=8, num_tokens=1, width=4))
        >>> mlp(torch.randn(16, 8, 1, 4)).shape
        torch.Size([16, 64])
    """

    def __init__(self, settings: settings.MLP, shape: HistoryShape) -> None:
        super().__init__(shape, out_features=settings.hidden_dim)
        self.layers = torchrl.modules.MLP(
            _entries(shape),
            settings.hidden_dim,
            depth=settings.num_layers - 1,
            num_cells=settings.hidden_dim,
            activation_class=partial(make_activation, settings.activation),
            activate_last_layer=True,
        )

    def forward(self, tokens: Tensor) -> Tensor:
        """Float [..., K, L, D] -> float [..., hidden]."""
        return self.layers(tokens.flatten(-3))


class OFENet(HistoryEncoder):
    """Linear layers that each read the input and the outputs of all previous layers.

    Args:
        settings: width, layers and activation.
        shape: shape of the input.

    Example:
        >>> ofenet = OFENet(settings.OFENet(), HistoryShape(num_frames=1, num_tokens=1, width=11))
        >>> ofenet(torch.randn(8, 1, 1, 11)).shape
        torch.Size([8, 139])
    """

    def __init__(self, settings: settings.OFENet, shape: HistoryShape) -> None:
        inputs = _entries(shape)
        widths = [inputs + index * settings.hidden_dim for index in range(settings.num_layers)]
        super().__init__(shape, out_features=inputs + settings.num_layers * settings.hidden_dim)
        self.layers = nn.ModuleList(nn.Linear(width, settings.hidden_dim) for width in widths)
        self.activation = make_activation(settings.activation)

    def forward(self, tokens: Tensor) -> Tensor:
        """Float [..., K, L, D] -> input and all outputs, float [..., inputs + layers * hidden]."""
        x = tokens.flatten(-3)
        for layer in self.layers:
            x = torch.cat([x, self.activation(layer(x))], dim=-1)
        return x


class D2RL(HistoryEncoder):
    """Linear layers that each read the input and the output of the previous layer.

    Args:
        settings: width, layers and activation.
        shape: shape of the input.

    Example:
        >>> d2rl = D2RL(settings.D2RL(), HistoryShape(num_frames=1, num_tokens=1, width=11))
        >>> d2rl(torch.randn(8, 1, 1, 11)).shape
        torch.Size([8, 75])
    """

    def __init__(self, settings: settings.D2RL, shape: HistoryShape) -> None:
        inputs = _entries(shape)
        super().__init__(shape, out_features=inputs + settings.hidden_dim)
        widths = [inputs, *(settings.num_layers - 1) * [self.out_features]]
        self.layers = nn.ModuleList(nn.Linear(width, settings.hidden_dim) for width in widths)
        self.activation = make_activation(settings.activation)

    def forward(self, tokens: Tensor) -> Tensor:
        """Float [..., K, L, D] -> input and last output, float [..., inputs + hidden]."""
        x = features = tokens.flatten(-3)
        for layer in self.layers:
            features = torch.cat([x, self.activation(layer(features))], dim=-1)
        return features


def _entries(shape: HistoryShape) -> int:
    """Entries of all tokens of all frames."""
    return math.prod((shape.num_frames, shape.num_tokens, shape.width))
