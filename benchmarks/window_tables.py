"""History encoders that project each frame once, compared with copies of all windows.

``python -m benchmarks.window_tables``: a training step (forward, backward and Adam) on arrays, of
Enhanced_TIT with rotary positions and of GTrXL with one block, on one thread, alternating. 512
steps in sequences of 64, or of K steps where K is larger; in each sequence, one episode begins.
Both read the same table of frames and encode each frame once. They differ in the history encoder:
ours multiplies all queries with all keys of a sequence; the other one gathers the K tokens of each
window first.
"""

from __future__ import annotations

import argparse
import statistics
import time
from functools import partial
from itertools import product
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.report import publish, spread, table
from benchmarks.training_step import make_descent
from torchrl_tit.modules.frame_tables import FrameTable, table_of_first
from torchrl_tit.networks import EnhancedTIT, HistoryNetwork, build_network
from torchrl_tit.settings import GTrXL, Inner, Network

SAMPLES, WIDTH, REPEATS = 512, 4, 5
NETWORKS = ["Enhanced_TIT", "GTrXL"]
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


def make_network(name: str, num_frames: int) -> HistoryNetwork:
    """Builds a network on arrays, which are one patch."""
    if name == "Enhanced_TIT":
        return EnhancedTIT((WIDTH,), num_frames, patch_size=None, temporal_positions="rotary")
    inner = Inner(patch_size=None, every_block=False)
    settings = Network(frame=inner, history=GTrXL(num_blocks=1, num_heads=1), num_frames=num_frames)
    network = build_network(settings, (WIDTH,))
    assert isinstance(network, HistoryNetwork)
    return network


def main(arguments: list[str] | None = None) -> None:
    """Measures, alternating, and reports."""
    parser = argparse.ArgumentParser("python -m benchmarks.window_tables")
    parser.add_argument("--num-frames", type=int, nargs="+", default=NUM_FRAMES, metavar="K")
    parser.add_argument("--seconds", type=float, default=0.5, help="of each measurement")
    parser.add_argument("--out", type=Path, help="folder for window_tables.md and .json")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    rows, numbers = [], {}
    for name, num_frames in product(NETWORKS, options.num_frames):
        torch.manual_seed(0)
        frames = make_table(num_frames)
        network = make_network(name, num_frames)
        losses = [read(network, in_table, frames).item() for in_table in (True, False)]
        torch.testing.assert_close(*losses, rtol=1e-4, atol=1e-6)
        steps = [
            make_descent(network, partial(read, network, in_table), frames, compiled=False)
            for in_table in (True, False)
        ]
        pairs = [[_milliseconds(step, options.seconds) for step in steps] for _ in range(REPEATS)]
        ours, theirs = (list(column) for column in zip(*pairs, strict=True))
        ratios = [b / a for a, b in pairs]
        rows.append([name, num_frames, spread(ours, 1), spread(theirs, 1), spread(ratios, 1)])
        numbers[f"{name}, K = {num_frames}"] = {
            "table_ms": ours,
            "copies_ms": theirs,
            "ratios": ratios,
            "median_ratio": statistics.median(ratios),
        }
    markdown = (
        "# Windows on a table of frames\n\n"
        f"{SAMPLES} steps, one thread, {REPEATS} rounds, alternating: median (range).\n\n"
        + table(["network", "K", "table, ms", "copies of windows, ms", "ratio, pair by pair"], rows)
    )
    command = "python -m benchmarks.window_tables"
    publish("window_tables", markdown, numbers, options.out, command)


def _milliseconds(step: object, seconds: float) -> float:
    """The milliseconds that a step takes, measured over at least ``seconds``."""
    assert callable(step)
    step()
    count, start = 0, time.perf_counter()
    while count == 0 or time.perf_counter() - start < seconds:
        step()
        count += 1
    return 1000 * (time.perf_counter() - start) / count


if __name__ == "__main__":
    main()
