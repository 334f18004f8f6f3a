"""The heads of stochastic policies."""

from __future__ import annotations

from torch import Tensor, nn

_LOG_STD_MIN, _LOG_STD_MAX = -5.0, 2.0


class GaussianHead(nn.Module):
    """Mean and standard deviation of each entry of an action, before a tanh squashes it.

    Zheng et al., "Online Decision Transformer", arXiv 2202.05607, and its authors' code: two linear
    layers with orthogonal initialization; a tanh keeps the logarithm of the standard deviation
    between -5 and 2.

    Args:
        in_features: size F of the features.
        action_dim: entries A of an action.

    Example:
        >>> import torch
        >>> mean, std = GaussianHead(64, 3)(torch.randn(8, 20, 64))
        >>> mean.shape, bool(((std > 0.006) & (std < 7.4)).all())
        (torch.Size([8, 20, 3]), True)
    """

    def __init__(self, in_features: int, action_dim: int) -> None:
        super().__init__()
        self.mean = nn.Linear(in_features, action_dim)
        self.log_std = nn.Linear(in_features, action_dim)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initializes the weights orthogonally and the biases with zeros."""
        for layer in (self.mean, self.log_std):
            nn.init.orthogonal_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Float [..., F] -> mean and standard deviation, float [..., A] each."""
        middle, half = (_LOG_STD_MAX + _LOG_STD_MIN) / 2, (_LOG_STD_MAX - _LOG_STD_MIN) / 2
        log_std = middle + half * self.log_std(features).tanh()
        return self.mean(features), log_std.exp()


class ClampedGaussianHead(nn.Module):
    """Mean and standard deviation of each entry of an action, before a tanh squashes it.

    Haarnoja et al., "Soft Actor-Critic Algorithms and Applications", arXiv 1812.05905, and their
    code: two linear layers with PyTorch's default initialization; the logarithm of the standard
    deviation is clamped to -20..2.

    Args:
        in_features: size F of the features.
        action_dim: entries A of an action.

    Example:
        >>> import torch
        >>> mean, std = ClampedGaussianHead(64, 3)(torch.randn(8, 64))
        >>> mean.shape, std.shape
        (torch.Size([8, 3]), torch.Size([8, 3]))
    """

    def __init__(self, in_features: int, action_dim: int) -> None:
        super().__init__()
        self.mean = nn.Linear(in_features, action_dim)
        self.log_std = nn.Linear(in_features, action_dim)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Float [..., F] -> mean and standard deviation, float [..., A] each."""
        return self.mean(features), self.log_std(features).clamp(-20.0, 2.0).exp()
