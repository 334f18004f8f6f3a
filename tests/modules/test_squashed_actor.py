"""The density of squashed actions, also where they have reached their bounds."""

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch.nn import functional as F
from torchrl.data import Bounded
from torchrl.modules import TanhNormal
from torchrl.modules.distributions.utils import rsample_and_log_prob

from torchrl_tit.modules import make_squashed_actor

pytestmark = pytest.mark.numerics

LOW, HIGH = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 10.0])


def distribution(mean: float, std: float, dtype: torch.dtype, samples: int = 1000) -> TanhNormal:
    """That of the actor, whose mean and log standard deviation are leaves."""
    actor = make_squashed_actor(3, Bounded(LOW, HIGH))
    parameters = {
        "loc": torch.full((samples, 2), mean, dtype=dtype, requires_grad=True),
        "scale": torch.full((samples, 2), std, dtype=dtype, requires_grad=True),
    }
    return actor[-1].get_dist(TensorDict(parameters, [samples]))


def density(x: torch.Tensor, mean: float, std: float) -> torch.Tensor:
    """The exact log density of the action whose value before the tanh is x, float64 [..., 2]."""
    half = ((HIGH - LOW) / 2).double()
    normal = -(((x - mean) / std) ** 2) / 2 - math.log(std) - math.log(2 * math.pi) / 2
    return (normal - half.log() - 2 * (math.log(2) - x - F.softplus(-2 * x))).sum(-1)


@pytest.mark.parametrize("std", [0.5, 1.0, 7.0])
@pytest.mark.parametrize("mean", [0.0, -4.0, 8.0, 20.0])
def test_samples_have_their_exact_density_and_gradient(mean, std):
    """The value before the tanh is known: mean + std * noise."""
    dist = distribution(mean, std, torch.float32)
    torch.manual_seed(0)
    action, log_prob = rsample_and_log_prob(dist)
    assert (action >= LOW).all()
    assert (action <= HIGH).all()
    torch.manual_seed(0)
    x = dist.base_dist.rsample().detach().double()
    saturated = (x.abs() > 7.5).double().mean()
    assert saturated > 0.5 or mean < 8
    tolerance: Any = {"rtol": 1e-5, "atol": 1e-4}
    torch.testing.assert_close(log_prob.double(), density(x, mean, std), **tolerance)
    # With the noise fixed, only the width of the normal and the tanh change with the parameters.
    slopes = torch.autograd.grad(log_prob.sum(), [dist.loc, dist.scale])
    of_mean, noise = 2 * x.tanh(), (x - mean) / std
    torch.testing.assert_close(slopes[0].double(), of_mean, **tolerance)
    torch.testing.assert_close(slopes[1].double(), of_mean * noise - 1 / std, **tolerance)


@pytest.mark.parametrize(("dtype", "gap"), [(torch.float32, 1e-6), (torch.float64, 1e-15)])
def test_given_actions_at_a_bound_are_evaluated_next_to_it(dtype, gap):
    mean, std = 1.0, 0.5
    dist = distribution(mean, std, dtype, samples=2)
    log_prob = dist.log_prob(torch.stack([LOW, HIGH]).to(dtype))
    x = torch.tensor([[gap - 1] * 2, [1 - gap] * 2], dtype=dtype).atanh().double()
    tolerance: Any = {"rtol": 1e-5, "atol": 0}
    torch.testing.assert_close(log_prob.double(), density(x, mean, std), **tolerance)
    (slope,) = torch.autograd.grad(log_prob.sum(), dist.loc)
    torch.testing.assert_close(slope.double(), (x - mean) / std**2, **tolerance)
