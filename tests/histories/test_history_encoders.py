"""What history encoders share: one token of several, frames themselves, states; and the MLPs."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn
from torchrl.modules import set_recurrent_mode

from tests.networks.reference import randomize
from tests.numerics import assert_near
from torchrl_tit import settings
from torchrl_tit.histories import HistoryShape
from torchrl_tit.networks import D2RL, MLP, Catformer, CoBERL, GTrXL, OFENet
from torchrl_tit.settings import HistorySettings

ONE_TOKEN: list[HistorySettings] = [
    settings.Outer(num_heads=2),
    settings.Outer(num_heads=2, dense=True, temporal_positions="learned"),
    settings.Catformer(num_heads=2),
    settings.CoBERL(num_heads=2, hidden_dim=5),
    settings.LSTM(hidden_dim=5),
    settings.MinGRU(),
    settings.GatedDeltaNet(),
    settings.Mamba2(),
    settings.GTrXL(num_heads=2),
]


@pytest.mark.parametrize("choices", ONE_TOKEN, ids=repr)
def test_several_tokens_become_one_by_a_linear_layer(choices: HistorySettings) -> None:
    several = choices.build(HistoryShape(num_frames=3, num_tokens=2, width=8)).double()
    one = choices.build(HistoryShape(num_frames=3, num_tokens=1, width=8)).double()
    randomize(several)
    weights = several.state_dict()
    linear = {name: weights.pop(f"one_token.linear.{name}") for name in ("weight", "bias")}
    one.load_state_dict(weights)
    tokens = torch.randn(4, 3, 2, 8, dtype=torch.float64)
    merged = nn.functional.linear(tokens.flatten(-2), linear["weight"], linear["bias"])
    torch.testing.assert_close(several(tokens), one(merged.unsqueeze(-2)))
    assert several(tokens).shape == (4, several.out_features)
    for ours, theirs in zip(
        several.attention_maps(tokens), one.attention_maps(merged.unsqueeze(-2)), strict=True
    ):
        torch.testing.assert_close(ours, theirs)


RECURRENT: dict[str, tuple[Any, Any]] = {
    "lstm": (settings.LSTM(hidden_dim=5), nn.LSTM),
    "gru": (settings.GRU(hidden_dim=5), nn.GRU),
}


@pytest.mark.parametrize("name", RECURRENT)
def test_recurrent_encoders_read_several_frames_from_a_state_of_zeros(name: str) -> None:
    choices, layer = RECURRENT[name]
    encoder = choices.build(HistoryShape(num_frames=3, num_tokens=1, width=8))
    reference = layer(8, 5, batch_first=True)
    reference.load_state_dict(getattr(encoder.memory, name).state_dict())
    tokens = torch.randn(2, 4, 3, 1, 8)
    expected, _ = reference(tokens.reshape(8, 3, 8))
    torch.testing.assert_close(encoder(tokens), expected[:, -1].reshape(2, 4, 5))
    for name, parameter in reference.named_parameters():
        if name.startswith("bias"):
            assert not parameter.any()
        else:
            square = parameter.T @ parameter if name.endswith("hh_l0") else None
            if square is not None:
                torch.testing.assert_close(square, torch.eye(5))


@pytest.mark.parametrize("name", RECURRENT)
def test_recurrent_encoders_read_sequences_from_a_given_state(name: str) -> None:
    """One frame a step: PyTorch's layer on each episode, which starts at 0 inside the sequence."""
    choices, layer = RECURRENT[name]
    encoder = choices.build(HistoryShape(num_frames=1, num_tokens=1, width=8)).double()
    randomize(encoder)
    reference = layer(8, 5, batch_first=True).double()
    reference.load_state_dict(getattr(encoder.memory, name).state_dict())
    tokens = torch.randn(2, 6, 1, 8, dtype=torch.float64)
    is_init = torch.zeros(2, 6, 1, dtype=torch.bool)
    is_init[:, 4] = True
    state = {
        key: torch.randn(2, 6, *shape, dtype=torch.float64) * ~is_init.unsqueeze(-1)
        for key, shape in encoder.state_shapes.items()
    }
    with set_recurrent_mode(True):
        states, after = encoder.step(tokens, state, is_init)
    assert list(after) == list(state)
    given = tuple(x[:, 0].transpose(0, 1).contiguous() for x in state.values())
    first, _ = reference(tokens[:, :4, 0], given if len(given) > 1 else given[0])
    second, _ = reference(tokens[:, 4:, 0])
    expected = torch.cat([first, second], dim=1)
    torch.testing.assert_close(states, expected)
    torch.testing.assert_close(
        torch.autograd.grad(states.square().sum(), list(encoder.parameters()), retain_graph=True),
        torch.autograd.grad(expected.square().sum(), list(reference.parameters())),
    )
    torch.testing.assert_close(after["recurrent_state_h"][:, -1, 0], second[:, -1])


def test_transformers_over_time_read_several_frames() -> None:
    for kind in (Catformer, CoBERL, GTrXL):
        with pytest.raises(ValueError, match="over time, but num_frames is 1: set it to 2 or more"):
            kind((84, 84), 1)


@pytest.mark.numerics
@pytest.mark.usefixtures("float64")
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


@pytest.mark.numerics
@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize("kind", [OFENet, D2RL])
def test_a_history_is_read_as_one_array(kind: type[Any]) -> None:
    network, flat = kind((5,), 4), kind((20,), 1)
    flat.load_state_dict(network.state_dict())
    x = torch.randn(3, 4, 5)
    torch.testing.assert_close(network(x), flat(x.flatten(1).unsqueeze(1)))
