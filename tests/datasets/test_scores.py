"""Normalised scores against the reference values."""

import numpy as np
import pytest
import torch

from torchrl_tit.datasets import has_reference, normalized_score, normalized_spread


@pytest.mark.parametrize(
    ("name", "random", "expert"),
    [
        ("halfcheetah-medium-replay-v0", -280.178953, 12135.0),
        ("mujoco/hopper/medium-v0", -20.272305, 3234.3),
        ("Walker2d-v5", 1.629008, 4592.3),
    ],
)
def test_scores(name: str, random: float, expert: float) -> None:
    returns = torch.tensor([random, expert, (random + expert) / 2], dtype=torch.float64)
    expected = torch.tensor([0.0, 100.0, 50.0], dtype=torch.float64)
    torch.testing.assert_close(normalized_score(returns, name), expected)
    np.testing.assert_allclose(normalized_score(returns.numpy(), name), expected, atol=1e-12)
    # The standard deviation of scores is the score of a standard deviation, without the offset.
    spread = normalized_spread(returns.std(), name)
    torch.testing.assert_close(spread, normalized_score(returns, name).std())
    assert not has_reference("CartPole-v1")
