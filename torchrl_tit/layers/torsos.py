"""The convolutions of NatureCNN and of the residual baseline."""

from __future__ import annotations

from torch import Tensor, nn

from torchrl_tit.layers.images import ImageConv2d, convolved_size


class NatureCNNTorso(nn.Module):
    """Three convolutions with relu: 32 filters of 8x8, stride 4; 64 of 4x4, stride 2; 64 of 3x3.

    Mnih et al., "Human-level control through deep reinforcement learning", Nature 518 (2015).

    Args:
        channels: channels of the image.
        size: height and width in pixels, at least 36.

    Example:
        >>> import torch
        >>> NatureCNNTorso(4, (84, 84))(torch.zeros(2, 4, 84, 84)).shape
        torch.Size([2, 3136])
    """

    smallest_image = 36
    """Pixels per side that leave one position after the last convolution."""

    def __init__(self, channels: int, size: tuple[int, int]) -> None:
        super().__init__()
        height, width = (convolved_size(side, [(8, 4), (4, 2), (3, 1)]) for side in size)
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
    """A convolution with 64 filters of 8x8 and stride 4, relu, two residual blocks, flattened.

    As the authors of arXiv 2212.14538 built it for ResNet and Catformer.

    Args:
        channels: channels of the image.
        size: height and width in pixels, at least 8.

    Example:
        >>> import torch
        >>> ResNetTorso(4, (84, 84))(torch.zeros(2, 4, 84, 84)).shape
        torch.Size([2, 25600])
    """

    smallest_image = 8
    """Pixels per side that the first convolution needs."""

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


TORSOS: dict[str, type[NatureCNNTorso] | type[ResNetTorso]] = {
    "nature-cnn": NatureCNNTorso,
    "resnet": ResNetTorso,
}
"""Convolutions by the name that settings use."""
