"""GTrXL against the equations of its paper, and gates that start near the identity."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from tests.layers.test_gated_block import written_out
from tests.networks.reference import randomize
from tests.numerics import assert_near
from torchrl_tit import settings
from torchrl_tit.histories import HistoryShape
from torchrl_tit.histories.gtrxl import GTrXL
from torchrl_tit.layers import GatedTransformerBlock, GRUGate, init_normal_, init_orthogonal_
from torchrl_tit.networks import GTrXL as GTrXLSystem

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]

WIDTH, FRAMES = 8, 4


def make(num_tokens: int = 1, gate_bias: float = 2.0, num_blocks: int = 2) -> GTrXL:
    choices = settings.GTrXL(num_heads=2, gate_bias=gate_bias, num_blocks=num_blocks)
    encoder = choices.build(HistoryShape(num_frames=FRAMES, num_tokens=num_tokens, width=WIDTH))
    assert isinstance(encoder, GTrXL)
    return encoder


def layer_norm(norm: nn.LayerNorm, x: Tensor) -> Tensor:
    centered = x - x.mean(-1, keepdim=True)
    return centered / (centered.square().mean(-1, keepdim=True) + norm.eps).sqrt() * norm.weight + (
        norm.bias
    )


def written_out_block(block: GatedTransformerBlock, x: Tensor) -> Tensor:
    """One history [K, D]: LayerNorm on the branch, attention or FFN, relu, gate."""
    attended = written_out(block.attention, layer_norm(block.norm1, x), causal=True)
    x = block.gate1(x, attended.clamp(min=0))
    first, _, second = block.ffn
    assert isinstance(first, nn.Linear)
    assert isinstance(second, nn.Linear)
    hidden = (layer_norm(block.norm2, x) @ first.weight.T + first.bias).clamp(min=0)
    return block.gate2(x, (hidden @ second.weight.T + second.bias).clamp(min=0))


def test_it_is_the_equations_of_the_paper_with_their_gradients() -> None:
    encoder = make()
    randomize(encoder)
    tokens = torch.randn(2, FRAMES, 1, WIDTH, requires_grad=True)
    outputs = []
    for x in tokens[:, :, 0]:
        for block in encoder.blocks:
            assert isinstance(block, GatedTransformerBlock)
            x = written_out_block(block, x)
        outputs.append(x[-1])
    expected, actual = torch.stack(outputs), encoder(tokens)
    assert_near(actual, expected)
    probe, inputs = torch.randn_like(actual), [tokens, *encoder.parameters()]
    assert_near(
        list(torch.autograd.grad((actual * probe).sum(), inputs)),
        list(torch.autograd.grad((expected * probe).sum(), inputs)),
    )


def test_gates_start_near_the_identity_and_survive_initialization() -> None:
    tokens = torch.randn(2, FRAMES, 1, WIDTH)
    newest = tokens[:, -1, 0]
    distances = [(make(gate_bias=bias)(tokens) - newest).norm() for bias in (0, 2, 9)]
    assert distances[0] > 2 * distances[1] > 4 * distances[2]
    torch.testing.assert_close(make(gate_bias=9)(tokens), newest, rtol=0, atol=0.01)
    network = GTrXLSystem((20, 20), FRAMES, embed_dim=WIDTH, num_heads=2, features_dim=4)
    for initialize in (init_orthogonal_, init_normal_):
        initialize(network)
        gates = [module for module in network.modules() if isinstance(module, GRUGate)]
        assert len(gates) == 4  # two a block
        assert all((gate.bias == 2).all() for gate in gates)
