"""What the paper says about the flow of information, and what the options change."""

from __future__ import annotations

from typing import Any, get_args

import pytest
import torch
from torch import Tensor, nn

from tests.networks.reference import randomize
from tests.numerics import assert_near
from torchrl_tit.histories.outer import StackedOuterTransformer
from torchrl_tit.layers import TransformerBlock
from torchrl_tit.networks import EnhancedTIT, HistoryNetwork, VanillaTIT
from torchrl_tit.settings import TemporalPositions

pytestmark = [pytest.mark.numerics, pytest.mark.usefixtures("float64")]


def depends_on(outputs: Tensor, inputs: Tensor) -> bool:
    (gradient,) = torch.autograd.grad(
        outputs.sum(), inputs, allow_unused=True, retain_graph=True, materialize_grads=True
    )
    return bool((gradient != 0).any())


def make(kind: type[Any], **settings: Any) -> HistoryNetwork:
    network = kind((3,), 4, embed_dim=16, num_heads_inner=2, num_heads_outer=2, **settings)
    randomize(network)
    assert isinstance(network, HistoryNetwork)
    return network


@pytest.mark.parametrize("kind", [EnhancedTIT, VanillaTIT])
@pytest.mark.parametrize("temporal", get_args(TemporalPositions))
def test_one_outer_block_sees_the_past_as_a_set_unless_steps_have_positions(
    kind: type[Any], temporal: TemporalPositions
) -> None:
    # Enhanced_TIT's outer blocks never stand on each other; Vanilla_TIT's do where there are two.
    blocks = 2 if kind is EnhancedTIT else 1
    network = make(kind, num_blocks=blocks, temporal_positions=temporal)
    history = torch.randn(6, 4, 3)
    shuffled_past = history[:, [2, 0, 1, 3]]
    difference = (network(history) - network(shuffled_past)).abs().max()
    if temporal != "none":
        assert difference > 1e-2
    else:
        assert difference < 1e-9
    # The newest step is no member of the set.
    assert (network(history) - network(history[:, [3, 0, 1, 2]])).abs().max() > 1e-2


def test_steps_of_stacked_outer_blocks_see_no_later_ones() -> None:
    outer = make(VanillaTIT, num_blocks=3).history_encoder
    assert isinstance(outer, StackedOuterTransformer)
    steps = [torch.randn(2, 16, requires_grad=True) for _ in range(4)]
    x = torch.stack(steps, dim=1)
    for block in outer.blocks:
        x = block(x)
        for step in range(4):
            for other in range(4):
                assert depends_on(x[:, step], steps[other]) == (other <= step)


def test_enhanced_outer_blocks_do_not_read_each_other() -> None:
    network = make(EnhancedTIT, num_blocks=3)
    tokens = [torch.randn(2, 4, 16, requires_grad=True) for _ in range(3)]
    outputs = network.history_encoder(torch.stack(tokens, dim=2)).unflatten(-1, (3, 16))
    for block in range(3):
        for other in range(3):
            assert depends_on(outputs[:, block], tokens[other]) == (block == other)


def test_without_dense_connection_only_the_last_pair_is_read() -> None:
    network = make(EnhancedTIT, num_blocks=3, dense=False)
    assert len(network.history_encoder.blocks) == 1  # type: ignore[arg-type]
    assert network.frames[0](torch.randn(2, 4, 3)).shape == (2, 4, 1, 16)


@pytest.mark.parametrize("kind", [EnhancedTIT, VanillaTIT])
def test_shared_blocks_are_one(kind: type[Any]) -> None:
    def count(**settings: Any) -> int:
        return sum(p.numel() for p in make(kind, **settings).parameters())

    block = sum(p.numel() for p in TransformerBlock(16, 2).parameters())
    assert count(num_blocks=3) - count(num_blocks=3, share_blocks=True) == 2 * 2 * block


DROPOUTS = [
    f"{kind}_dropout_{part}" for kind in ("attention", "ffn") for part in ("inner", "outer")
]


@pytest.mark.parametrize("kind", [EnhancedTIT, VanillaTIT])
@pytest.mark.parametrize("num_frames", [1, 3])
@pytest.mark.parametrize("setting", DROPOUTS)
def test_each_dropout_acts_alone_while_training_only(
    kind: type[Any], num_frames: int, setting: str
) -> None:
    torch.manual_seed(0)
    network = kind((3,), num_frames, **{setting: 0.5})
    randomize(network)
    history = torch.randn(8, num_frames, 3)
    network.train()
    assert not torch.equal(network(history), network(history))
    network.eval()
    assert torch.equal(network(history), network(history))
    undropped = kind((3,), num_frames)
    undropped.load_state_dict(network.state_dict())
    assert_near(network(history), undropped.train()(history))


@pytest.mark.parametrize("setting", DROPOUTS)
def test_each_dropout_sits_where_its_name_says(setting: str) -> None:
    network = make(EnhancedTIT, **{setting: 0.5})
    kind, _, part = setting.split("_")
    side = {"inner": "frame_encoders.observation", "outer": "history_encoder"}[part]
    layer = {"attention": "attention.dropout", "ffn": "ffn.3"}[kind]
    active = {n for n, m in network.named_modules() if isinstance(m, nn.Dropout) and m.p}
    assert active == {f"{side}.blocks.{index}.{layer}" for index in range(2)}
