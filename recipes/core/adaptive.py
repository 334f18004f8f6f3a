"""What adapts to a task: the scales of rewards and of advantages."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchrl_tit.layers import standardize


class ReturnScale:
    """The running standard deviation of the discounted return, by which rewards are divided.

    As in `VecNormalize` of Stable-Baselines3 and OpenAI Baselines, the return of the rewards so
    far, ``r_t + gamma * R_{t-1}``, starts at 0 in each episode. Here nothing is clipped, and the
    statistics are those up to the end of the batch whose rewards are divided; no policy reads them.
    A resumed run begins new episodes, so a checkpoint holds the statistics alone. TorchRL's
    `VecNormV2` and `RewardScaling` scale by single rewards, or by a number that is known in
    advance.

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
        current = torch.zeros_like(reward[:, 0]) if self.returns is None else self.returns
        returns = []
        for now, ended in zip(reward.unbind(1), done.unbind(1), strict=True):
            current = current * self.gamma + now
            returns.append(current)
            current = current.masked_fill(ended, 0.0)
        self.returns = current
        values = torch.stack(returns).cpu().double()
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
        """Returns the statistics."""
        return {"statistics": self.statistics}

    def load_state_dict(self, state_dict: dict[str, Any], /) -> None:
        """Restores a state; all episodes begin anew."""
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
    return standardize(advantage, advantage.mean(), advantage.std().clamp(min=floor), eps=1e-8)
