"""MLP: the network of arrays in most of reinforcement learning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import nn

from torchrl_tit.networks.activations import make_activation
from torchrl_tit.networks.config import override_config
from torchrl_tit.networks.two_trunks import TrunkConfig, TwoTrunkNetwork, check_array


@dataclass(frozen=True, kw_only=True)
class MLPConfig(TrunkConfig):
    """Hyperparameters of MLP."""


class MLP(TwoTrunkNetwork):
    """Linear layers with an activation, apart for policy and value.

    The baseline of arXiv 2212.14538 for arrays: two tanh layers of 64 (K = 1). With K > 1 it reads
    the stacked frames, all their entries at once. The weights start as PyTorch's layers do.

    Args:
        observation_shape: (D,).
        history: number of observations K >= 1.
        config: hyperparameters.
        **hyperparameters: fields of :class:`MLPConfig` that override those of ``config``.

    Raises:
        ValueError: if observations are not arrays, or a hyperparameter is not possible.
        TypeError: if there is no such hyperparameter, or ``config`` is that of another network.

    Example:
        >>> import torch
        >>> policy, value = MLP(observation_shape=(4,), history=8)(torch.randn(16, 8, 4))
        >>> policy.shape, value.shape
        (torch.Size([16, 64]), torch.Size([16, 64]))
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        history: int = 1,
        config: MLPConfig | None = None,
        **hyperparameters: Any,
    ) -> None:
        config = override_config(MLPConfig, config, hyperparameters)
        check_array(observation_shape, history, single=False)
        entries = history * observation_shape[0]
        super().__init__(
            observation_shape,
            history,
            policy=_make_trunk(entries, config),
            value=_make_trunk(entries, config),
            features_dim=config.hidden_dim,
        )
        self.config = config


def _make_trunk(in_features: int, config: MLPConfig) -> nn.Sequential:
    layers: list[nn.Module] = []
    for _ in range(config.num_layers):
        layers += [nn.Linear(in_features, config.hidden_dim), make_activation(config.activation)]
        in_features = config.hidden_dim
    return nn.Sequential(*layers)
