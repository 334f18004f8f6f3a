"""What the paper says about the flow of information, and what the options change."""

from __future__ import annotations

from typing import Any, get_args

import pytest
import torch
from torch import Tensor, nn

from tests.networks.reference import randomize
from tests.numerics import assert_near
from torchrl_tit import settings
from torchrl_tit.histories.outer import StackedOuterTransformer
from torchrl_tit.layers import SelfAttention, TransformerBlock
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


def test_stacked_outer_blocks_tell_past_steps_apart_by_their_masks() -> None:
    network = make(VanillaTIT, num_blocks=2)
    history = torch.randn(6, 4, 3)
    assert (network(history) - network(history[:, [2, 0, 1, 3]])).abs().max() > 1e-3


@pytest.mark.parametrize("kind", [EnhancedTIT, VanillaTIT])
def test_tokens_of_a_frame_depend_on_that_frame_alone(kind: type[Any]) -> None:
    network = make(kind)
    frames = [torch.randn(1, 3, requires_grad=True) for _ in range(4)]
    tokens = network.frames[0](torch.stack(frames, dim=1))  # [1, K, L, D]
    for step in range(4):
        for other in range(4):
            assert depends_on(tokens[:, step], frames[other]) == (step == other)
    # The same frame has the same tokens at every step.
    alone = network.frames[0](frames[2])
    torch.testing.assert_close(tokens[:, 2], alone, rtol=0, atol=1e-5)


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


@pytest.mark.parametrize("kind", [EnhancedTIT, VanillaTIT])
def test_newest_features_depend_on_every_frame(kind: type[Any]) -> None:
    network = make(kind)
    history = torch.randn(2, 4, 3, requires_grad=True)
    network(history).square().sum().backward()
    assert history.grad is not None
    assert (history.grad.abs().amax(dim=(0, 2)) > 0).all()


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


@pytest.mark.parametrize("kind", [EnhancedTIT, VanillaTIT])
def test_features_dim_says_the_size_of_the_features(kind: type[Any]) -> None:
    network = make(kind, features_dim=24)
    assert network.features_dim == 24
    assert network(torch.randn(2, 4, 3)).shape == (2, 24)


@pytest.mark.parametrize("heads", [1, 4])
@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("length", [1, 2, 5])
@pytest.mark.parametrize("training", [False, True])
def test_attention_equals_multihead_attention_and_exchanges_state_dicts(
    heads: int, causal: bool, length: int, training: bool
) -> None:
    ours = SelfAttention(8, heads, causal=causal, dropout=0.3).eval()
    if training:
        ours.dropout.p = 1e-12  # takes the path with dropout, drops nothing
        ours.train()
    theirs = nn.MultiheadAttention(8, heads, batch_first=True)
    randomize(ours)
    theirs.load_state_dict(ours.state_dict())
    x = torch.randn(3, length, 8)
    mask = torch.ones(length, length, dtype=torch.bool).triu(1) if causal else None
    expected, weights = theirs(x, x, x, attn_mask=mask, average_attn_weights=False)
    assert_near(ours(x), expected)
    assert_near(ours(x, read="first"), expected[:, :1])
    assert_near(ours(x, read="last"), expected[:, -1:])
    for positions in (slice(None), slice(-2, None), slice(0, None, 2)):
        assert_near(ours(x, positions), expected[:, positions])
    assert_near(ours.weights(x), weights)


@pytest.mark.parametrize("causal", [False, True])
@pytest.mark.parametrize("training", [False, True])
def test_a_mask_takes_the_place_of_the_causal_one(causal: bool, training: bool) -> None:
    ours = SelfAttention(8, 2, causal=causal, dropout=1e-12).train(training)
    theirs = nn.MultiheadAttention(8, 2, batch_first=True)
    randomize(ours)
    theirs.load_state_dict(ours.state_dict())
    x = torch.randn(3, 5, 8)
    sees = torch.rand(3, 1, 5, 5) < 0.5
    sees |= torch.eye(5, dtype=torch.bool)
    expected, _ = theirs(x, x, x, attn_mask=~sees.repeat_interleave(2, dim=0).flatten(0, 1))
    for read, positions in (("all", slice(None)), ("first", slice(0, 1)), ("last", slice(4, 5))):
        actual = ours(x, read, sees)
        assert_near(actual, expected[:, positions])
    assert_near(ours(x, slice(1, 3), sees), expected[:, 1:3])


@pytest.mark.parametrize("length", [1, 3])
@pytest.mark.parametrize("read", ["all", "first", "last"])
def test_attention_dropout_leaves_the_mean_as_it_is(length: int, read: Any) -> None:
    attention = SelfAttention(8, 2, causal=True, dropout=0.25)
    randomize(attention)
    x = torch.randn(1, length, 8)
    expected = attention.eval()(x, read)
    many = attention.train()(x.expand(20_000, -1, -1), read)
    # The output is linear in the weights, so its mean is that without dropout.
    error = (many.mean(0) - expected[0]).abs()
    assert (many.std(0) > 1e-3).all()
    assert (error < 6 * many.std(0) / 20_000**0.5).all()


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


def test_features_need_not_be_normalized() -> None:
    head = settings.Head(features_dim=8, final_norm=False)
    network = HistoryNetwork(
        settings.Inner(embed_dim=8), settings.PairedOuter(), observation_shape=(4,), head=head
    )
    assert [type(layer).__name__ for layer in network.head.children()] == [
        "LayerNorm",
        "Linear",
        "Tanh",
    ]
