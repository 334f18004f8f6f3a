"""History encoders that project each frame once, compared with copies of all windows.

A training step (forward, backward and Adam) on arrays, of Enhanced_TIT with rotary positions, on
one thread, alternating. 512 steps in sequences of 64, or of K steps where K is larger; in each
sequence, one episode begins.
Both read the same table of frames and encode each frame once. They differ in the history encoder:
ours multiplies all queries with all keys of a sequence; the other one gathers the K tokens of each
window first.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchrl_tit.modules.frame_tables import FrameTable, table_of_first
from torchrl_tit.networks import EnhancedTIT, HistoryNetwork

from .measuring import ratios, take_turns
from .segments import make_descent

SAMPLES, WIDTH, ROUNDS, SECONDS = 512, 4, 5, 0.5
NUM_FRAMES = [4, 16, 32, 64, 128, 256, 512]


def make_table(num_frames: int) -> FrameTable:
    """Lays out random frames of sequences; in each, an episode begins after a third."""
    length = max(64, num_frames)
    count = SAMPLES // length
    is_init = torch.zeros(count, length, dtype=torch.bool)
    is_init[:, length // 3] = True
    first, later = torch.randn(count, num_frames, WIDTH), torch.randn(count, length, WIDTH)
    return table_of_first([first], [later], is_init, "same")


def read(network: HistoryNetwork, in_table: bool, frames: FrameTable) -> Tensor:
    """A loss of the features of all steps."""
    windows = frames.windows if in_table else frames.windows._replace(span=None)
    return network.encode_windows(frames.frames, windows).square().mean()


def main(num_frames: Sequence[int] = NUM_FRAMES, seconds: float = SECONDS) -> dict[str, Any]:
    """Measures, alternating."""
    numbers = {}
    for k in num_frames:
        torch.manual_seed(0)
        frames = make_table(k)
        network = EnhancedTIT((WIDTH,), k, patch_size=None, temporal_positions="rotary")
        losses = [read(network, in_table, frames).item() for in_table in (True, False)]
        torch.testing.assert_close(*losses, rtol=1e-4, atol=1e-6)
        steps = {
            way: make_descent(network, partial(read, network, way == "table_ms"), frames)
            for way in ("table_ms", "copies_ms")
        }
        times = take_turns(steps, ROUNDS, seconds)
        found = ratios(times["copies_ms"], times["table_ms"])
        numbers[f"Enhanced_TIT, K = {k}"] = {**times, "ratios": found}
    return numbers
