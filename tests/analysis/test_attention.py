"""Attention by observation and by step."""

from __future__ import annotations

import pytest
import torch

from tests.analysis.policies import IMAGE, IMAGE_NETWORKS
from tests.networks.maps import attention_maps
from tests.numerics import assert_near
from torchrl_tit.analysis import inner_attention, map_attention, outer_attention, roll_out
from torchrl_tit.networks import DecisionTransformer, HistoryNetwork, build_network
from torchrl_tit.networks.history_network import TwoTrunks
from torchrl_tit.settings.networks import mlp

pytestmark = pytest.mark.numerics


def build(name: str) -> HistoryNetwork:
    network = build_network(IMAGE_NETWORKS[name], IMAGE)
    assert isinstance(network, HistoryNetwork)
    return network.eval()


@pytest.mark.parametrize("name", ["enhanced", "without outer"])
def test_inner_blocks(name: str) -> None:
    network, histories = build(name), torch.rand(2, 3, *IMAGE)
    blocks = inner_attention(network, histories)["observation"]
    frames = 1 if name == "without outer" else 3
    assert [weights.shape for weights in blocks] == 2 * [(2, frames, 2, 13, 13)]
    for weights, expected in zip(blocks, attention_maps(network, histories).inner, strict=True):
        assert_near(weights.reshape(expected.shape), expected.detach())
    maps = map_attention(network, histories)["observation"]
    assert maps.shape == (2, frames, 3, 4)
    assert_near(maps.sum((-2, -1)), torch.ones(2, frames))


def test_a_map_lies_where_the_patch_is() -> None:
    network = build("enhanced")
    before = map_attention(network, torch.zeros(3, *IMAGE))["observation"]
    image = torch.zeros(3, *IMAGE)
    image[:, 12:24, 36:48] = 1  # row 1, column 3
    changed = (map_attention(network, image)["observation"] - before).abs()
    assert changed[0].flatten().argmax() == 1 * 4 + 3


def test_roll_out_by_hand() -> None:
    first = torch.tensor([[[1.0, 0.0], [1.0, 0.0]], [[0.0, 1.0], [1.0, 0.0]]])  # two heads
    second = torch.tensor([[[0.0, 1.0], [0.0, 1.0]]])  # one head
    # Half of the mean over the heads, half of the identity.
    one = torch.tensor([[0.75, 0.25], [0.5, 0.5]])
    two = torch.tensor([[0.5, 0.5], [0.0, 1.0]])
    assert_near(roll_out([first]), one)
    assert_near(roll_out([first, second]), two @ one)
    with pytest.raises(ValueError, match="no attention weights to roll out"):
        roll_out([])


@pytest.mark.parametrize(("name", "heads"), [("enhanced", 2), ("catformer", 5), ("coberl", 8)])
def test_outer_blocks(name: str, heads: int) -> None:
    network, histories = build(name), torch.rand(2, 3, *IMAGE)
    shares = outer_attention(network, histories)
    assert shares.shape == (2, 2, heads, 3)
    assert_near(shares.sum(-1), torch.ones(2, 2, heads))
    newest = [weights[..., -1, :] for weights in attention_maps(network, histories).outer]
    assert_near(shares, torch.stack(newest, 1).detach())


@pytest.mark.usefixtures("float64")
def test_decision_transformer() -> None:
    network = DecisionTransformer((4,), action_dim=2, num_frames=5, embed_dim=8, num_heads=2)
    network.eval()
    mask = torch.ones(3, 5)
    mask[:, :2] = 0  # two steps of padding
    inputs = (
        torch.randn(3, 5, 4),
        torch.randn(3, 5, 2),
        torch.randn(3, 5, 1),
        torch.arange(5).expand(3, 5),
        mask,
    )
    shares = outer_attention(network, *inputs)
    assert shares.shape == (3, 3, 2, 5)
    assert_near(shares.sum(-1), torch.ones(3, 3, 2))
    assert not shares[..., :2].any(), "padding is read"
    assert (shares[..., 2:] > 0).all()
    for weights in attention_maps(network, *inputs).outer:
        assert weights.shape == (3, 2, 5, 5)
        assert not weights.triu(1).any(), "a step reads a later one"


def test_networks_without_attention() -> None:
    with pytest.raises(ValueError, match="no attention over the parts of an observation"):
        inner_attention(build("resnet"), torch.rand(3, *IMAGE))
    with pytest.raises(ValueError, match="StackedCNN has no attention over time"):
        outer_attention(build("resnet"), torch.rand(3, *IMAGE))
    with pytest.raises(ValueError, match="StackedInnerTransformer has no attention over time"):
        outer_attention(build("without outer"), torch.rand(3, *IMAGE))
    with pytest.raises(ValueError, match="does not fit this network"):
        inner_attention(build("enhanced"), torch.rand(2, *IMAGE))
    trunks = build_network(mlp(), (4,))
    assert isinstance(trunks, TwoTrunks)
    with pytest.raises(ValueError, match="MLP has no attention over time"):
        outer_attention(trunks.policy, torch.rand(1, 4))
