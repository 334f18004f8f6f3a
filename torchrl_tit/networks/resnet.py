"""The residual network of the baselines: alone, or as frame encoder."""

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
    as_images,
    check_image,
    convolved_size,
    stacked_shape,
)

SMALLEST_IMAGE = 8
"""Pixels a side that the first convolution needs."""


class ResidualBlock(nn.Module):
    """``x + relu(conv3x3(x))``.

    Args:
        channels: channels of input and output.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, padding=1)
        self.activation = nn.ReLU()

    def forward(self, x: Tensor) -> Tensor:
        """Float [N, channels, H, W] -> the same."""
        return x + self.activation(self.conv(x))


class ResNetTorso(nn.Module):
    """64 convolutions of 8x8 stride 4 with relu, two residual blocks, flattened.

    As the authors of arXiv 2212.14538 built it for ResNet and Catformer.

    Args:
        channels: channels of the image.
        size: height and width in pixels, at least 8.

    Example:
        >>> import torch
        >>> ResNetTorso(4, (84, 84))(torch.zeros(2, 4, 84, 84)).shape
        torch.Size([2, 25600])
    """

    def __init__(self, channels: int, size: tuple[int, int]) -> None:
        super().__init__()
        height, width = (convolved_size(side, [(8, 4)]) for side in size)
        self.out_features = 64 * height * width
        self.layers = nn.Sequential(
            ImageConv2d(channels, 64, 8, stride=4),
            nn.ReLU(),
            ResidualBlock(64),
            ResidualBlock(64),
            nn.Flatten(),
        )

    def forward(self, x: Tensor) -> Tensor:
        """[N, channels, H, W], float or uint8 -> float [N, out_features]."""
        return self.layers(x)


class ResNetFrameEncoder(nn.Module):
    """Maps one image to one token: the ResNet torso and a linear layer.

    The frame encoder of Catformer and CoBERL.

    Args:
        observation_shape: (H, W) or (C, H, W), at least 8 pixels a side.
        embed_dim: width of the token.

    Example:
        >>> import torch
        >>> ResNetFrameEncoder((84, 84), 255)(torch.zeros(2, 4, 84, 84)).shape
        torch.Size([2, 4, 1, 255])
    """

    num_tokens = 1

    def __init__(self, observation_shape: Sequence[int], embed_dim: int) -> None:
        super().__init__()
        self.observation_ndim = len(observation_shape)
        self.torso = ResNetTorso(*stacked_shape(observation_shape))
        self.linear = nn.Linear(self.torso.out_features, embed_dim)

    def forward(self, observation: Tensor) -> Tensor:
        """[..., (C,) H, W], float or uint8 -> float [..., 1, D]."""
        images, leading = as_images(observation, self.observation_ndim)
        return self.linear(self.torso(images)).reshape(*leading, 1, self.linear.out_features)


@dataclass(frozen=True, kw_only=True)
class ResNetConfig:
    """Hyperparameters of the ResNet baseline."""

    features_dim: int = 512
    """Size of the features that the network puts out."""

    def __post_init__(self) -> None:
        check_positive(self, "features_dim")


class ResNet(HistoryNetwork):
    """ResNet: the frames stacked as channels, the ResNet torso, one linear layer with relu.

    The baseline "ResNet + MLP" of arXiv 2212.14538. The weights start as PyTorch's layers do.

    Args:
        observation_shape: (H, W) or (C, H, W), at least 8 pixels a side.
        history: number of observations K >= 1.
        config: hyperparameters.
        **hyperparameters: fields of :class:`ResNetConfig` that override those of ``config``.

    Raises:
        ValueError: if observations are not images of that size, or a hyperparameter is not
            possible.
        TypeError: if there is no such hyperparameter, or ``config`` is that of another network.

    Example:
        >>> import torch
        >>> network = ResNet(observation_shape=(84, 84), history=4)
        >>> network(torch.zeros(2, 4, 84, 84, dtype=torch.uint8)).shape
        torch.Size([2, 512])
    """

    def __init__(
        self,
        observation_shape: Sequence[int],
        history: int = 1,
        config: ResNetConfig | None = None,
        **hyperparameters: Any,
    ) -> None:
        config = override_config(ResNetConfig, config, hyperparameters)
        check_image(observation_shape, history, SMALLEST_IMAGE)
        torso = ResNetTorso(*stacked_shape(observation_shape, history))
        super().__init__(
            observation_shape,
            history,
            frame_encoder=None,
            history_encoder=StackedFrames(torso, len(observation_shape)),
            head=nn.Sequential(nn.Linear(torso.out_features, config.features_dim), nn.ReLU()),
            features_dim=config.features_dim,
        )
        self.config = config
