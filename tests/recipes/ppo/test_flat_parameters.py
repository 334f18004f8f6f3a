"""Parameters in one tensor train as they would on their own."""

import copy

import pytest
import torch
from torch import nn

from recipes.core.flat_parameters import FlatParameters
from tests.numerics import assert_near


@pytest.mark.usefixtures("float64")
def test_clipping_and_adam_take_the_same_steps():
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(3, 5), nn.LayerNorm(5), nn.Tanh(), nn.Linear(5, 2))
    alone = copy.deepcopy(network)
    flat = FlatParameters(list(network.parameters())).flat
    optimizer = torch.optim.Adam([flat], lr=0.1, fused=True)
    other = torch.optim.Adam(alone.parameters(), lr=0.1, fused=True)
    for _ in range(5):
        x = torch.randn(7, 3)
        optimizer.zero_grad(set_to_none=False)
        network(x).square().sum().backward()
        norm = nn.utils.clip_grad_norm_(flat, 0.5)
        optimizer.step()
        other.zero_grad()
        alone(x).square().sum().backward()
        assert_near(norm, nn.utils.clip_grad_norm_(alone.parameters(), 0.5))
        other.step()
        assert_near(list(network.parameters()), list(alone.parameters()))


def test_parameters_stay_views_when_weights_are_loaded():
    network, saved = nn.Linear(2, 2), nn.Linear(2, 2)
    flat = FlatParameters(list(network.parameters())).flat
    network.load_state_dict(saved.state_dict())
    assert torch.equal(flat, torch.cat([p.flatten() for p in saved.parameters()]))
    network(torch.ones(1, 2)).sum().backward()
    assert flat.grad is not None
    assert torch.equal(flat.grad, torch.ones(6))
