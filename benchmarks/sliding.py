"""What it costs that outer blocks read each other, over all frames or over the nearest ones.

Two outer blocks on arrays of 4. A step of acting and a training step on sequences of 64, as in
``benchmarks.memories``. One thread, processor time, alternating.
"""

from __future__ import annotations

from typing import Any

from torchrl_tit.modules import Backbone
from torchrl_tit.networks import build_network
from torchrl_tit.settings import ChainedOuter, HistorySettings, Inner, Network, PairedOuter

from .memories import WIDTH, measure

ATTENDED, LENGTH, SECONDS = 32, 64, 1.0
_OUTER: dict[str, Any] = {"num_heads": 2, "temporal_positions": "rotary"}
HISTORIES: dict[str, HistorySettings] = {
    "paired": PairedOuter(**_OUTER),
    "chained": ChainedOuter(**_OUTER),
    "chained, sliding": ChainedOuter(**_OUTER, attention_frames=ATTENDED),
}


def make_backbone(name: str) -> Backbone:
    """Builds a network whose two outer blocks see 2 * 32 - 1 frames."""
    settings = Network(
        frame=Inner(patch_size="auto", num_heads=2),
        history=HISTORIES[name],
        num_frames=2 * ATTENDED - 1,
    )
    return Backbone(build_network(settings, (WIDTH,)), padding="same")


def main(length: int = LENGTH, seconds: float = SECONDS) -> dict[str, Any]:
    """Measures, alternating between the networks."""
    rows: dict[str, dict[str, Any]] = {name: {} for name in HISTORIES}
    for what, found in measure(make_backbone, list(HISTORIES), length, seconds).items():
        for name, milliseconds in found.items():
            rows[name][f"{what}_ms"] = milliseconds
    return rows
