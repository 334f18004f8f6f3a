"""MLP, OFENet and D2RL: separate trunks for policy and value."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from tests.numerics import assert_near
from torchrl_tit.networks import D2RL, MLP, OFENet

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]


@pytest.mark.parametrize(("num_frames", "layers", "hidden"), [(1, 2, 64), (8, 2, 64), (3, 1, 7)])
def test_mlp_equals_layers_in_a_row(num_frames: int, layers: int, hidden: int) -> None:
    network = MLP((5,), num_frames, num_layers=layers, hidden_dim=hidden)
    x = torch.randn(6, num_frames, 5)
    for trunk, latent in zip((network.policy, network.value), network(x), strict=True):
        y = x.reshape(6, 5 * num_frames)  # oldest first
        linears = [module for module in trunk.modules() if isinstance(module, nn.Linear)]
        assert len(linears) == layers
        for linear in linears:
            y = torch.tanh(y @ linear.weight.T + linear.bias)
        assert_near(latent, y)
        assert latent.shape == (6, hidden) == (6, network.features_dim)


@pytest.mark.parametrize("kind", [OFENet, D2RL])
def test_a_history_is_read_as_one_array(kind: type[Any]) -> None:
    network, flat = kind((5,), 4), kind((20,), 1)
    flat.load_state_dict(network.state_dict())
    x = torch.randn(3, 4, 5)
    torch.testing.assert_close(network(x), flat(x.flatten(1).unsqueeze(1)))
