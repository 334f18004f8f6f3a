"""The table of flows: counted from settings, and measured with gradients."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from torchrl_tit.analysis import Flows, MeasuredFlows, count_flows, flow_table, measure_flows
from torchrl_tit.histories import HistoryEncoder, HistoryShape
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


@pytest.mark.parametrize(("blocks", "frames"), [(1, 1), (2, 4), (4, 3)])
def test_the_papers_table(blocks: int, frames: int) -> None:
    """arXiv 2212.14538, table "The number of information flows for Different TIT backbones"."""
    lk, before = blocks * frames, (blocks - 1) * frames
    vanilla = count_flows(vanilla_tit(frames, num_blocks=blocks))
    assert vanilla == Flows(lk, blocks, before, blocks - 1, frames, 0)
    enhanced = count_flows(enhanced_tit(frames, num_blocks=blocks))
    assert enhanced == Flows(lk, blocks, before, blocks, lk, 0)


def counted(measured: MeasuredFlows, network: Network) -> Flows:
    """What the rule counts, from what was measured: dense connections are units over time."""
    dense = measured.temporal_to_output if is_dense(network) else 0
    return Flows(
        measured.spatial,
        measured.temporal,
        measured.spatial_to_spatial,
        measured.temporal_to_temporal + dense,
        measured.spatial_to_temporal,
        measured.temporal_to_spatial,
    )


def is_dense(network: Network) -> bool:
    if isinstance(network.history, Outer):
        return network.history.dense
    return network.history.name.endswith("ed-outer") and getattr(network.frame, "every_block", True)


CASES: dict[str, Network] = {
    "one block": enhanced_tit(3, num_blocks=1),
    "shared blocks": enhanced_tit(3, num_blocks=3, share_blocks=True),
    "shared, stacked": vanilla_tit(2, num_blocks=3, share_blocks=True),
    "chained": replace(enhanced_tit(3, num_blocks=3), history=ChainedOuter()),
    "all class tokens, stacked": replace(enhanced_tit(3), history=Outer()),
    "flat frames": replace(lstm(3), frame=Flat()),
}


@pytest.mark.parametrize("name", CASES)
def test_gradients_confirm_what_is_counted(name: str) -> None:
    network = CASES[name]
    measured = measure_flows(build(network))
    assert counted(measured, network) == count_flows(network)
    assert measured.temporal_to_spatial == 0


def test_the_documented_table() -> None:
    named = {name: make(4) for name, make in NETWORKS.items()}
    named |= {
        "enhanced-tit, chained": replace(enhanced_tit(4), history=ChainedOuter()),
        "enhanced-tit, w/o Dense": enhanced_tit(4, dense=False),
        "enhanced-tit, w/o Inner": enhanced_tit(4, inner=False),
        "enhanced-tit, w/o Outer": enhanced_tit(4, outer=False),
    }
    table = flow_table(named)
    assert table in DOCUMENT.read_text(encoding="utf-8")
    for row in table.splitlines()[2:]:
        assert "measured" not in row, "gradients find another number"
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        between, read = map(int, cells[-1].split(","))
        dense = read if read > 1 else 0  # a dense connection counts as a unit over time
        assert int(cells[5]) == between + dense, row


def test_what_gradients_say_of_tit() -> None:
    # Enhanced_TIT's outer blocks read none of each other; the output reads all.
    enhanced = measure_flows(build(enhanced_tit(4, num_blocks=3)))
    assert enhanced == MeasuredFlows(12, 3, 8, 0, 3, 12, 0)
    vanilla = measure_flows(build(vanilla_tit(4, num_blocks=3)))
    assert vanilla == MeasuredFlows(12, 3, 8, 2, 1, 4, 0)
    alone = measure_flows(build(vanilla_tit(1, num_blocks=3)))
    assert alone.temporal == 0, "one frame has no past"


def test_measuring_leaves_the_network_and_the_random_numbers_as_they_are() -> None:
    network = build(enhanced_tit(2, num_blocks=1, embed_dim=8))
    before = {name: value.clone() for name, value in network.state_dict().items()}
    state = torch.get_rng_state()
    measure_flows(network)
    assert torch.equal(state, torch.get_rng_state())
    assert network.training
    assert network(torch.randn(2, 2, 4)).requires_grad
    for name, value in network.state_dict().items():
        assert torch.equal(value, before[name])
    assert not any(module._forward_hooks for module in network.modules())


class Newest(HistoryEncoder):
    def __init__(self, settings: NewestHistory, shape: HistoryShape) -> None:
        super().__init__(shape, out_features=shape.width)
        self.linear = nn.Linear(shape.width, shape.width)

    def forward(self, tokens: Tensor) -> Tensor:
        return self.linear(tokens[..., -1, 0, :])


@dataclass(frozen=True, kw_only=True)
class NewestHistory(HistorySettings, name="tests-newest", builds=f"{__name__}:Newest"):
    pass


def test_an_encoder_of_ones_own() -> None:
    network = Network(frame=Linear(), history=NewestHistory(), num_frames=2)
    with pytest.raises(ValueError, match=r"no rule counts .* encoder 'tests-newest'"):
        count_flows(network)
    with pytest.raises(ValueError, match="Newest has no blocks that are known here"):
        measure_flows(build(network))
