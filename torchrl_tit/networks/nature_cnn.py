"""NatureCNN: the convolutional network of DQN."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from torchrl_tit.networks.config import check_positive, override_config
from torchrl_tit.networks.history_network import HistoryNetwork
from torchrl_tit.networks.images import (
    ImageConv2d,
    StackedFrames,
    check_image,
    convolved_size,
    stacked_shape,
)

_KERNELS = [(8, 4), (4, 2), (3, 1)]
_SMALLEST = 36  # pixels a side that leave one position after the last convolution


@dataclass(frozen=True, kw_only=True)
class NatureCNNConfig:
    """Hyperparameters of NatureCNN (Mnih et al. 2015, "Methods"; as in Stable-Baselines3)."""

    features_dim: int = 512
    """Size of the features that the network puts out."""

    def __post_init__(self) -> None:
        check_positive(self, "features_dim")


class NatureCNNTorso(nn.Module):
    """Three convolutions with relu: 32 of 8x8 stride 4, 64 of 4x4 stride 2, 64 of 3x3.

    Args:
        channels: channels of the image.
        size: height and width in pixels, at least 36.

    Example:
        >>> import torch
        >>> NatureCNNTorso(4, (84, 84))(torch.zeros(2, 4, 84, 84)).shape
        torch.Size([2, 3136])
    """

    def __init__(self, channels: int, size: tuple[int, int]) -> None:
        super().__init__()
        height, width = (convolved_size(side, _KERNELS) for side in size)
        self.out_features = 64 * height * width
        self.layers = nn.Sequential(
            ImageConv2d(channels, 32, 8, stride=4),
            nn.ReLU(),
            nn.Conv2d(32, 64, 4, stride=2),
            nn.ReLU(),
            nn.Conv2d(64, 64, 3),
            nn.ReLU(),
            nn.Flatten(),
        )

    def forward(self, x: Tensor) -> Tensor:
        """[N, channels, H, W], float or uint8 -> float [N, out_features]."""
        return self.layers(x)


class NatureCNN(HistoryNetwork):
    """NatureCNN: the frames stacked as channels, three convolutions, one linear layer with relu.

    Mnih et al., "Human-level control through deep reinforcement learning", Nature 518 (2015); the
    baseline "NatureCNN + MLP" of arXiv 2212.14538. The weights start as PyTorch's layers do.

    Args:
        observation_shape: (H, W) or (C, H, W), at least 36 pixels a side.
        history: number of observations K >= 1.
        config: hyperparameters.
        **hyperparameters: fields of :class:`NatureCNNConfig` that override those of ``config``.

    Raises:
        ValueError: if observations are not images of that size, or a hyperparameter is not
            possible.
        TypeError: if there is no such hyperparameter, or ``config`` is that of another network.

    Example:
        >>> import torch
        >>> network = NatureCNN(observation_shape=(84, 84), history=4)
        >>> network(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 512])
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        history: int = 1,
        config: NatureCNNConfig | None = None,
        **hyperparameters: Any,
    ) -> None:
        config = override_config(NatureCNNConfig, config, hyperparameters)
        check_image(observation_shape, history, _SMALLEST)
        torso = NatureCNNTorso(*stacked_shape(observation_shape, history))
        super().__init__(
            observation_shape,
            history,
            frame_encoder=None,
            history_encoder=StackedFrames(torso, len(observation_shape)),
            head=nn.Sequential(nn.Linear(torso.out_features, config.features_dim), nn.ReLU()),
            features_dim=config.features_dim,
        )
        self.config = config
