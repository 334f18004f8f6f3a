"""OFENet: every layer adds features to those before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_tit.networks.activations import make_activation
from torchrl_tit.networks.config import override_config
from torchrl_tit.networks.two_trunks import TrunkConfig, TwoTrunkNetwork, check_array


@dataclass(frozen=True, kw_only=True)
class OFENetConfig(TrunkConfig):
    """Hyperparameters of OFENet."""


class OFENetTrunk(nn.Module):
    """Layers that each read the input and the outputs of all layers before.

    Args:
        in_features: entries D of the input.
        config: hyperparameters.

    Example:
        >>> OFENetTrunk(11, OFENetConfig())(torch.randn(8, 11)).shape
        torch.Size([8, 139])
    """

    def __init__(self, in_features: int, config: OFENetConfig) -> None:
        super().__init__()
        widths = [in_features + index * config.hidden_dim for index in range(config.num_layers)]
        self.layers = nn.ModuleList(nn.Linear(width, config.hidden_dim) for width in widths)
        self.activation = make_activation(config.activation)
        self.out_features = in_features + config.num_layers * config.hidden_dim

    def forward(self, x: Tensor) -> Tensor:
        """Float [..., D] -> input and all outputs, float [..., D + layers * hidden]."""
        for layer in self.layers:
            x = torch.cat([x, self.activation(layer(x))], dim=-1)
        return x


class OFENet(TwoTrunkNetwork):
    """OFENet: MLP with dense connections, apart for policy and value.

    Ota et al., "Can Increasing Input Dimensionality Improve Deep Reinforcement Learning?", ICML
    2020, as built for the baseline of arXiv 2212.14538: without its auxiliary loss. The weights
    start as PyTorch's layers do.

    Args:
        observation_shape: (D,).
        history: number of observations; 1.
        config: hyperparameters.
        **hyperparameters: fields of :class:`OFENetConfig` that override those of ``config``.

    Raises:
        ValueError: if observations are not arrays, the history is longer than 1, or a
            hyperparameter is not possible.
        TypeError: if there is no such hyperparameter, or ``config`` is that of another network.

    Example:
        >>> policy, value = OFENet(observation_shape=(11,))(torch.randn(16, 1, 11))
        >>> policy.shape, value.shape
        (torch.Size([16, 139]), torch.Size([16, 139]))
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        history: int = 1,
        config: OFENetConfig | None = None,
        **hyperparameters: Any,
    ) -> None:
        config = override_config(OFENetConfig, config, hyperparameters)
        check_array(observation_shape, history, single=True)
        policy, value = (OFENetTrunk(observation_shape[0], config) for _ in range(2))
        super().__init__(
            observation_shape,
            history,
            policy=policy,
            value=value,
            features_dim=policy.out_features,
        )
        self.config = config
