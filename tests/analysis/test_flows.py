"""The table of flows, by gradients, beside the numbers that the paper prints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from torch import Tensor, nn

from torchrl_tit.analysis import Flows, count_flows, flow_table
from torchrl_tit.histories import HistoryEncoder, HistoryShape
from torchrl_tit.layers import SelfAttention
from torchrl_tit.networks import HistoryNetwork, build_network
from torchrl_tit.settings import (
    NETWORKS,
    ChainedOuter,
    Flat,
    HistorySettings,
    Linear,
    Network,
    Outer,
)
from torchrl_tit.settings.networks import enhanced_tit, lstm, vanilla_tit

DOCUMENT = Path(__file__).parents[2] / "docs" / "analysis.md"


def build(network: Network) -> HistoryNetwork:
    built = build_network(network, (4,), trunks="shared")
    assert isinstance(built, HistoryNetwork)
    return built


@pytest.mark.parametrize("share", [False, True])
@pytest.mark.parametrize(("blocks", "frames"), [(2, 2), (2, 4), (4, 3)])
def test_the_papers_table(blocks: int, frames: int, share: bool) -> None:
    """arXiv 2212.14538, table "The number of information flows for Different TIT backbones"."""
    lk, before = blocks * frames, (blocks - 1) * frames
    vanilla = vanilla_tit(frames, num_blocks=blocks, share_blocks=share)
    assert count_flows(build(vanilla)) == Flows(lk, blocks, before, blocks - 1, frames, 0, 1)
    enhanced = enhanced_tit(frames, num_blocks=blocks, share_blocks=share)
    assert count_flows(build(enhanced)) == Flows(lk, blocks, before, blocks, lk, 0, blocks)


CASES: dict[str, tuple[Network, Flows]] = {
    "one block": (enhanced_tit(3, num_blocks=1), Flows(3, 1, 0, 0, 3, 0, 1)),
    "one frame has no past": (vanilla_tit(1, num_blocks=3), Flows(3, 0, 2, 2, 1, 0, 1)),
    "chained": (
        replace(enhanced_tit(3, num_blocks=3), history=ChainedOuter()),
        Flows(9, 3, 6, 2 + 3, 9, 0, 3),
    ),
    "all class tokens, stacked": (
        replace(enhanced_tit(3), history=Outer()),
        Flows(6, 2, 3, 1, 6, 0, 1),
    ),
    "flat frames": (replace(lstm(3), frame=Flat()), Flows(0, 1, 0, 0, 3, 0, 1)),
}


@pytest.mark.parametrize("name", CASES)
def test_other_networks(name: str) -> None:
    network, flows = CASES[name]
    assert count_flows(build(network)) == flows


def test_the_documented_table() -> None:
    named = {name: make(4) for name, make in NETWORKS.items()}
    zeros = "| 0 | 0 | 0 | 0 | 0 | 0 | 0, 0 |"
    none = {name for name, network in named.items() if zeros in flow_table({name: network})}
    assert none == {"nature-cnn", "resnet", "mlp", "ofenet", "d2rl"}
    named = {name: network for name, network in named.items() if name not in none}
    recurrent = ("lstm", "gru", "mingru", "gated-deltanet", "mamba2")
    for name in (*recurrent, "coberl", "gtrxl", "decision-transformer"):
        del named[name]  # are not on the page
    named |= {
        "enhanced-tit, chained": replace(enhanced_tit(4), history=ChainedOuter()),
        "enhanced-tit, w/o Dense": enhanced_tit(4, dense=False),
        "enhanced-tit, w/o Inner": enhanced_tit(4, inner=False),
        "enhanced-tit, w/o Outer": enhanced_tit(4, outer=False),
    }
    assert flow_table(named) in DOCUMENT.read_text(encoding="utf-8")


class Own(HistoryEncoder):
    """Attends to the frames, in modules of any name."""

    def __init__(self, settings: OwnHistory, shape: HistoryShape) -> None:
        super().__init__(shape, out_features=shape.width)
        self.where = settings.where
        layers = nn.ModuleList(SelfAttention(shape.width, 1) for _ in range(2))
        self.add_module(self.where, layers)

    def forward(self, tokens: Tensor) -> Tensor:
        leading = tokens.shape[:-3]
        x = tokens.reshape(-1, self.shape.num_frames, self.shape.width)
        for layer in getattr(self, self.where):
            x = layer(x)
        return x[:, -1].reshape(*leading, self.out_features)


@dataclass(frozen=True, kw_only=True)
class OwnHistory(HistorySettings, name="tests-own-flows", builds=f"{__name__}:Own"):
    where: str = "blocks"


def test_an_encoder_of_ones_own() -> None:
    """Its flows follow from its modules, without a rule for it."""
    network = Network(frame=Linear(), history=OwnHistory(), num_frames=3)
    assert count_flows(build(network)) == Flows(0, 2, 0, 1, 3, 0, 1)
    hidden = replace(network, history=OwnHistory(where="attention"))
    with pytest.raises(ValueError, match="Own has attention, but no blocks that are known here"):
        count_flows(build(hidden))
