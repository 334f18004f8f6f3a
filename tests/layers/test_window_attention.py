"""Windows on a table read as copies of them do, in values and gradients."""

from dataclasses import replace

import pytest
import torch

from torchrl_tit.layers.attention import RelativeSelfAttention, SelfAttention
from torchrl_tit.layers.window_attention import attend_windows, worth_a_table
from torchrl_tit.modules.frame_tables import find_starts, table_of_first, table_without_histories
from torchrl_tit.networks import EnhancedTIT, build_network
from torchrl_tit.settings import ChainedOuter, GTrXL, Inner, Network, Outer
from torchrl_tit.windows import Windows, find_windows

SEQUENCES, STEPS, K, WIDTH = 3, 9, 5, 8
POSITIONS = ["none", "relative", "rotary", "transformer-xl"]
TOLERANCES = dict.fromkeys(POSITIONS, 1e-10) | {"learned": 1e-10, "rotary": 1e-5}
"""Angles are float32."""


def make_attention(positions, **settings):
    torch.manual_seed(0)
    attention: SelfAttention | RelativeSelfAttention
    if positions == "transformer-xl":
        attention = RelativeSelfAttention(WIDTH, 2, K).double()
    else:
        attention = SelfAttention(
            WIDTH, 2, causal=True, positions=positions, num_frames=K, **settings
        ).double()
    for parameter in attention.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    return attention


def make_table(padding, stored=True, width=(WIDTH,)):
    """A table of sequences, the second of which has two starts and the third one every step."""
    torch.manual_seed(1)
    is_init = torch.zeros(SEQUENCES, STEPS, dtype=torch.bool)
    is_init[1, [0, 2, 6]] = True
    is_init[2] = True
    observations = [torch.randn(SEQUENCES, STEPS, *width, dtype=torch.float64)]
    if not stored:
        starts = find_starts(is_init, [])
        return table_without_histories(observations, is_init, starts, K, padding)
    first = [torch.randn(SEQUENCES, K, *width, dtype=torch.float64)]
    return table_of_first(first, observations, is_init, padding)


@pytest.mark.parametrize("stored", [True, False], ids=["stored", "padded"])
@pytest.mark.parametrize("positions", POSITIONS)
def test_attention_equals_that_on_copies(positions, stored):
    attention, table = make_attention(positions), make_table("same", stored)
    assert table.windows.span == (STEPS + K - 1 if stored else STEPS)
    assert table.windows.padded().any()
    assert not table.windows.padded().all()
    causal = {"causal": True} if positions == "transformer-xl" else {}
    results = []
    for read in (
        lambda x: attend_windows(attention, x, table.windows),
        lambda x: attention(table.windows.gather(x).flatten(0, 1), read="last", **causal).view(
            SEQUENCES, STEPS, WIDTH
        ),
    ):
        x = table.frames[0].clone().requires_grad_()
        output = read(x)
        weights = [p for p in attention.parameters()]
        gradients = torch.autograd.grad((output * output.detach().cos()).sum(), [x, *weights])
        results.append([output, *gradients])
    for ours, theirs in zip(*results, strict=True):
        tolerance = TOLERANCES[positions]
        torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=tolerance)


def test_dropout_drops_weights_of_single_frames():
    attention, table = make_attention("none", dropout=0.5), make_table("same")
    torch.nn.init.zeros_(attention.out_proj.bias)
    attention.train()
    draws = torch.stack(
        [attend_windows(attention, table.frames[0], table.windows) for _ in range(1000)]
    )
    expected = attention.eval()(table.windows.gather(table.frames[0]).flatten(0, 1), "last")
    error = draws.std(0) / len(draws) ** 0.5
    assert ((draws.mean(0).flatten(0, 1) - expected[:, 0]).abs() < 6 * error.flatten(0, 1)).all()
    # All K frames of an episode's first window are the same. Dropped one by one, 0 to K of them are
    # left for each of the two heads; if padding were dropped as a whole, there were 4 ways each.
    kept = draws[:, 2, 1, 0].mul(1e6).round().unique()
    assert 4**2 < len(kept) <= (K + 1) ** 2


def check_sequences(network, padding, tolerance, monkeypatch):
    """Compares features of sequences with those of histories; returns how often it read a table."""
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    table = make_table(padding, width=(4,))
    calls = []
    read_table = network.history_encoder.read_table

    def counted(*arguments):
        calls.append(arguments)
        return read_table(*arguments)

    monkeypatch.setattr(network.history_encoder, "read_table", counted)
    features = network.encode_windows(table.frames, table.windows)
    expected = network(table.windows.gather(table.frames[0]))
    weights = list(network.parameters())
    ours, theirs = ([x, *torch.autograd.grad(x.sin().sum(), weights)] for x in (features, expected))
    torch.testing.assert_close(ours, theirs, rtol=tolerance, atol=tolerance)
    return len(calls)


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("positions", ["none", "relative", "rotary", "learned"])
def test_tit_reads_sequences_as_histories(positions, padding, monkeypatch):
    torch.manual_seed(0)
    network = EnhancedTIT((4,), K, temporal_positions=positions).double()
    tables = check_sequences(network, padding, TOLERANCES[positions], monkeypatch)
    assert tables == (positions != "learned")


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("num_blocks", [1, 2])
def test_gtrxl_reads_sequences_as_histories(num_blocks, padding, monkeypatch):
    torch.manual_seed(0)
    gtrxl = GTrXL(num_blocks=num_blocks, num_heads=2)
    settings = Network(frame=Inner(), history=gtrxl, num_frames=K)
    network = build_network(settings, (4,)).double()
    tables = check_sequences(network, padding, 1e-10, monkeypatch)
    assert tables == (num_blocks == 1)


@pytest.mark.parametrize("padding", ["same", "constant"])
@pytest.mark.parametrize("positions", ["none", "rotary"])
@pytest.mark.parametrize("history", [Outer(), Outer(dense=True), ChainedOuter()])
def test_sliding_blocks_read_sequences_as_histories(history, positions, padding, monkeypatch):
    torch.manual_seed(0)
    history = replace(history, temporal_positions=positions, attention_frames=3)
    settings = Network(frame=Inner(), history=history, num_frames=K)
    network = build_network(settings, (4,)).double()
    assert check_sequences(network, padding, TOLERANCES[positions], monkeypatch) == 1


def test_when_a_table_is_worth_it():
    newest = torch.arange(40)
    windows = find_windows(newest, newest.clamp(max=0), 2, "same")
    assert not worth_a_table(windows)  # nothing is known of sequences
    assert worth_a_table(Windows(windows.rows[None], None, span=32))
    assert not worth_a_table(Windows(windows.rows[None], None, span=33))
