"""Networks of arrays whose policy and value share nothing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchrl_tit.networks.activations import Activation
from torchrl_tit.networks.config import check_positive
from torchrl_tit.networks.history_network import (
    check_history,
    check_observation,
    weights_dtype,
)


@dataclass(frozen=True, kw_only=True)
class TrunkConfig:
    """Hyperparameters of a trunk, by default those of Stable-Baselines3's policy for arrays."""

    hidden_dim: int = 64
    """Width of every layer."""
    num_layers: int = 2
    """Number of layers."""
    activation: Activation = "tanh"
    """Activation of every layer."""

    def __post_init__(self) -> None:
        check_positive(self, "hidden_dim", "num_layers")


class TwoTrunkNetwork(nn.Module):
    """Maps a history of arrays to features for the policy and features for the value.

    Two trunks of the same shape without shared weights, each on the entries of all K arrays.

    Args:
        observation_shape: (D,).
        history: number of observations K >= 1.
        policy: [N, K * D] -> [N, F].
        value: the same.
        features_dim: size F of the features of each trunk.
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        history: int,
        *,
        policy: nn.Module,
        value: nn.Module,
        features_dim: int,
    ) -> None:
        super().__init__()
        self.observation_shape = tuple(observation_shape)
        self.history = history
        self.features_dim = features_dim
        self.policy = policy
        self.value = value

    def forward(self, history: Tensor) -> tuple[Tensor, Tensor]:
        """Maps histories to features.

        Args:
            history: [..., K, D], oldest first; uint8 (divided by 255) or of the network's own float
                type (taken as it is).

        Returns:
            Features for the policy and for the value, float [..., F] each.
        """
        x = _flatten(history, self)  # [..., K * D]
        return self.policy(x), self.value(x)

    def only_policy(self) -> OneTrunkNetwork:
        """The network without the value's trunk, for an actor whose critics are apart.

        Example:
            >>> from torchrl_tit.networks import MLP
            >>> MLP((11,), history=4).only_policy()(torch.randn(8, 4, 11)).shape
            torch.Size([8, 64])
        """
        return OneTrunkNetwork(self)


class OneTrunkNetwork(nn.Module):
    """Maps a history of arrays to features, float [..., F], by the policy's trunk of a network.

    Args:
        network: the network, whose weights it shares.
    """

    def __init__(self, network: TwoTrunkNetwork) -> None:
        super().__init__()
        self.observation_shape = network.observation_shape
        self.history = network.history
        self.features_dim = network.features_dim
        self.policy = network.policy

    def forward(self, history: Tensor) -> Tensor:
        """Maps histories to features; see :class:`TwoTrunkNetwork`."""
        return self.policy(_flatten(history, self))


def _flatten(history: Tensor, network: TwoTrunkNetwork | OneTrunkNetwork) -> Tensor:
    """Checks a history and makes floats of it, all entries of all K steps in a row."""
    dtype = weights_dtype(network)
    check_history(history, network.history, network.observation_shape, dtype)
    if history.dtype == torch.uint8:
        history = history.to(dtype) / 255
    return history.flatten(-2)


def check_array(observation_shape: Sequence[int], history: int, *, single: bool) -> None:
    """Raises ValueError where observations are not arrays, or not single ones."""
    check_observation(observation_shape, history)
    if len(observation_shape) != 1:
        raise ValueError(
            f"observation_shape {tuple(observation_shape)} is that of an image, but this network "
            "reads arrays (D,): for images take NatureCNN, ResNet, Catformer, CoBERL, VanillaTIT "
            "or EnhancedTIT"
        )
    if single and history > 1:
        raise ValueError(
            f"this network reads one observation, not a history of {history}: set history to 1, "
            "or take MLP, VanillaTIT or EnhancedTIT"
        )
