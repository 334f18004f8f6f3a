"""D2RL: every layer sees the observation again."""

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
class D2RLConfig(TrunkConfig):
    """Hyperparameters of D2RL."""


class D2RLTrunk(nn.Module):
    """Layers that each read the input and the output of the layer before.

    Args:
        in_features: entries D of the input.
        config: hyperparameters.

    Example:
        >>> D2RLTrunk(11, D2RLConfig())(torch.randn(8, 11)).shape
        torch.Size([8, 75])
    """

    def __init__(self, in_features: int, config: D2RLConfig) -> None:
        super().__init__()
        self.out_features = in_features + config.hidden_dim
        widths = [in_features] + (config.num_layers - 1) * [self.out_features]
        self.layers = nn.ModuleList(nn.Linear(width, config.hidden_dim) for width in widths)
        self.activation = make_activation(config.activation)

    def forward(self, x: Tensor) -> Tensor:
        """Float [..., D] -> input and last output, float [..., D + hidden]."""
        features = x
        for layer in self.layers:
            features = torch.cat([x, self.activation(layer(features))], dim=-1)
        return features


class D2RL(TwoTrunkNetwork):
    """D2RL: MLP whose layers are all given the observation, apart for policy and value.

    Sinha et al., "D2RL: Deep Dense Architectures in Reinforcement Learning", arXiv 2010.09163, as
    built for the baseline of arXiv 2212.14538: the observation is put out too. The weights start as
    PyTorch's layers do.

    Args:
        observation_shape: (D,).
        history: number of observations; 1.
        config: hyperparameters.
        **hyperparameters: fields of :class:`D2RLConfig` that override those of ``config``.

    Raises:
        ValueError: if observations are not arrays, the history is longer than 1, or a
            hyperparameter is not possible.
        TypeError: if there is no such hyperparameter, or ``config`` is that of another network.

    Example:
        >>> policy, value = D2RL(observation_shape=(11,))(torch.randn(16, 1, 11))
        >>> policy.shape, value.shape
        (torch.Size([16, 75]), torch.Size([16, 75]))
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        history: int = 1,
        config: D2RLConfig | None = None,
        **hyperparameters: Any,
    ) -> None:
        config = override_config(D2RLConfig, config, hyperparameters)
        check_array(observation_shape, history, single=True)
        policy, value = (D2RLTrunk(observation_shape[0], config) for _ in range(2))
        super().__init__(
            observation_shape,
            history,
            policy=policy,
            value=value,
            features_dim=policy.out_features,
        )
        self.config = config
