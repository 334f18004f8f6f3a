"""Running scales of rewards and values, for tasks with returns of any scale."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn


class ReturnScale:
    """The running standard deviation of the discounted return, by which rewards are divided.

    As in `VecNormalize` of Stable-Baselines3 and OpenAI Baselines, the return of the rewards so
    far, ``r_t + gamma * R_{t-1}``, starts at 0 in each episode. Here the statistics are those up to
    the end of a batch. TorchRL's `VecNormV2` and `RewardScaling` scale by single rewards, or by a
    number that is known in advance.

    Args:
        gamma: discount factor.

    Example:
        >>> scale = ReturnScale(gamma=0.5)
        >>> reward, done = torch.ones(1, 4, 1), torch.zeros(1, 4, 1, dtype=torch.bool)
        >>> scale.update(reward, done)  # of 1, 1.5, 1.75 and 1.875
        tensor(0.3351)
    """

    def __init__(self, gamma: float) -> None:
        self.gamma = gamma
        self.statistics = torch.zeros(3, dtype=torch.float64)  # count, mean, sum of squares
        self.returns: Tensor | None = None

    def update(self, reward: Tensor, done: Tensor) -> Tensor:
        """Adds a batch, and returns the standard deviation, float [].

        Args:
            reward: float [envs, time, 1].
            done: bool [envs, time, 1].
        """
        current = self.returns
        if current is None or current.shape != reward[:, 0].shape:
            current = torch.zeros_like(reward[:, 0])
        returns = []
        for now, ended in zip(reward.unbind(1), done.unbind(1), strict=True):
            current = current * self.gamma + now
            returns.append(current)
            current = current.masked_fill(ended, 0.0)
        self.returns = current
        values = torch.stack(returns).double().cpu()
        count, mean, squares = self.statistics
        total, shift = count + values.numel(), values.mean() - mean
        self.statistics = torch.stack(
            [
                total,
                mean + shift * values.numel() / total,
                squares
                + (values - values.mean()).square().sum()
                + shift.square() * count * values.numel() / total,
            ]
        )
        return (self.statistics[2] / total).sqrt().float()

    def state_dict(self) -> dict[str, Any]:
        """Returns the statistics; a resumed run begins new episodes."""
        return {"statistics": self.statistics}

    def load_state_dict(self, state_dict: dict[str, Any], /) -> None:
        """Restores a state."""
        self.statistics, self.returns = state_dict["statistics"], None


class AdvantageScale:
    """The running standard deviation of advantages: the root mean square over all batches so far.

    Once a task is solved, advantages are almost pure noise, ten to a hundred times smaller than
    before. Divided only by their own standard deviation, they would move the policy as far as
    before.

    Example:
        >>> scale = AdvantageScale()
        >>> scale.update(torch.tensor([-3.0, 0.0, 3.0])), scale.update(torch.zeros(3))
        (3.0, 2.1213203435596424)
    """

    def __init__(self) -> None:
        self.batches = 0
        self.variances = 0.0

    def update(self, advantage: Tensor) -> float:
        """Adds a batch of advantages, float of any shape, and returns the running deviation."""
        self.batches += 1
        self.variances += advantage.var().item()
        return math.sqrt(self.variances / self.batches)

    def state_dict(self) -> dict[str, Any]:
        """Returns the sum of the variances and the number of batches."""
        return {"batches": self.batches, "variances": self.variances}

    def load_state_dict(self, state_dict: dict[str, Any], /) -> None:
        """Restores a state."""
        self.batches, self.variances = int(state_dict["batches"]), float(state_dict["variances"])


def normalize_advantages(advantage: Tensor, floor: float) -> Tensor:
    """Returns advantages with mean 0, divided by their standard deviation or by a larger floor.

    Example:
        >>> normalize_advantages(torch.tensor([-0.01, 0.01]), floor=0.1)
        tensor([-0.1000,  0.1000])
    """
    if advantage.numel() == 1:
        return advantage
    return (advantage - advantage.mean()) / advantage.std().clamp(min=floor)


class ValueHead(nn.Module):
    """A value head that adapts to the scale of the returns and can scale its gradient on features.

    The value is ``linear(features) * std + mean``, with the running mean and standard deviation of
    the value targets (PopArt, arXiv 1602.07714). When these change, the linear layer is adjusted so
    that all values stay the same. A squared error divided by ``std ** 2`` is that of the normalised
    values.

    Args:
        linear: the value head, [..., F] -> [..., 1].
        gradient: factor on the gradient that reaches the features; 0 stops it.
        decay: fraction of the old statistics that each batch keeps.

    Example:
        >>> head = ValueHead(nn.Linear(4, 1))
        >>> features = torch.randn(8, 4)
        >>> before = head(features)
        >>> head.update(torch.randn(64) * 10 - 50)
        >>> torch.allclose(head(features), before, atol=1e-4)
        True
    """

    moments: Tensor
    mean: Tensor
    std: Tensor

    def __init__(self, linear: nn.Linear, *, gradient: float = 1.0, decay: float = 0.9) -> None:
        super().__init__()
        self.linear = linear
        self.gradient = gradient
        self.decay = decay
        self.register_buffer("moments", torch.zeros(3))  # weight, mean, mean square
        self.register_buffer("mean", torch.zeros(()))
        self.register_buffer("std", torch.ones(()))

    def forward(self, features: Tensor) -> Tensor:
        """[..., F] -> values, float [..., 1]."""
        if self.gradient != 1:
            features = torch.lerp(features.detach(), features, self.gradient)
        return self.linear(features) * self.std + self.mean

    @torch.no_grad()
    def update(self, targets: Tensor) -> None:
        """Adds a batch of value targets, float of any shape."""
        batch = torch.stack([torch.ones_like(self.mean), targets.mean(), targets.square().mean()])
        self.moments.lerp_(batch, 1 - self.decay)
        mean, square = self.moments[1:] / self.moments[0]
        std = (square - mean.square()).clamp(min=1e-4).sqrt()
        self.linear.weight.mul_(self.std / std)
        self.linear.bias.mul_(self.std).add_(self.mean - mean).div_(std)
        self.mean.copy_(mean)
        self.std.copy_(std)
