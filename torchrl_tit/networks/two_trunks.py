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
        dtype = weights_dtype(self)
        check_history(history, self.history, self.observation_shape, dtype)
        if history.dtype == torch.uint8:
            history = history.to(dtype) / 255
        x = history.flatten(-2)  # [..., K * D]
        return self.policy(x), self.value(x)


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
