"""Histories sampled per second: HistoryStorage compared with a replay buffer with CatFrames.

Both sample batches of 256 transitions, with the histories of the observation and of the next one,
from the same episodes in memory, on one thread, alternating. CatFrames' sampler draws whole slices
of K transitions and stacks within them, so it never samples the first K - 1 steps of an episode.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs.transforms import CatFrames, Compose, UnsqueezeTransform

from torchrl_tit.datasets import HistoryStorage, episodes_from_arrays, make_replay_buffer

from .report import publish, spread, table

BATCH, REPEATS, SECONDS = 256, 5, 1.0
CASES = {  # observation shape, dtype, transitions, K
    "arrays of 11, K = 4": ((11,), torch.float32, 100_000, 4),
    "arrays of 11, K = 16": ((11,), torch.float32, 100_000, 16),
    "84 x 84 images, K = 4": ((84, 84), torch.uint8, 10_000, 4),
}


def make_stream(shape: tuple[int, ...], dtype: torch.dtype, steps: int) -> dict[str, torch.Tensor]:
    """Makes random transitions in episodes of 200 to 400 steps."""
    frames = torch.randint(0, 256, (steps + 1, *shape)).to(dtype)
    ends = torch.zeros(steps, dtype=torch.bool)
    ends[torch.randint(200, 400, (steps,)).cumsum(0).clamp(max=steps) - 1] = True
    return {
        "observations": frames[:-1],
        "next_observations": frames[1:],
        "actions": torch.zeros(steps, 3),
        "rewards": torch.zeros(steps),
        "terminals": ends,
    }


def make_ours(stream: dict[str, torch.Tensor], num_frames: int) -> ReplayBuffer:
    """Builds our buffer with the stream."""
    episodes = episodes_from_arrays(**stream)
    return make_replay_buffer(HistoryStorage(episodes, num_frames), BATCH)


def make_catframes(stream: dict[str, torch.Tensor], num_frames: int) -> ReplayBuffer:
    """Builds TorchRL's buffer with the same stream."""
    ends = stream["terminals"].unsqueeze(-1)
    data = TensorDict(
        {
            "observation": stream["observations"],
            "action": stream["actions"],
            "done": torch.zeros_like(ends),
            "next": {
                "observation": stream["next_observations"],
                "reward": stream["rewards"].unsqueeze(-1),
                "done": ends,
                "terminated": ends,
                "truncated": torch.zeros_like(ends),
            },
        },
        [len(ends)],
    )
    axis = -stream["observations"].ndim
    frames = CatFrames(
        num_frames, axis, in_keys=["history"], out_keys=["history"], reset_key="_reset"
    )
    transform, sampler = frames.make_rb_transform_and_sampler(
        BATCH, end_key=("next", "done"), cache_values=True
    )
    unsqueeze = UnsqueezeTransform(
        axis,
        in_keys=["observation", ("next", "observation")],
        out_keys=["history", ("next", "history")],
    )
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(len(data)),
        sampler=sampler,
        transform=Compose(unsqueeze, transform),
        batch_size=BATCH,
        collate_fn=lambda batch: batch,
    )
    buffer.extend(data)
    return buffer


def windows_per_second(sample: Callable[[], Any]) -> float:
    """Measures the transitions sampled per second."""
    batches, start = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - start) < SECONDS:
        assert len(sample()) == BATCH
        batches += 1
    return batches * BATCH / elapsed


def main(out: Path | None) -> None:
    """Measures, alternating, and reports."""
    torch.set_num_threads(1)
    rows, numbers = [], {}
    for case, (shape, dtype, steps, num_frames) in CASES.items():
        torch.manual_seed(0)
        stream = make_stream(shape, dtype, steps)
        ours, theirs = make_ours(stream, num_frames), make_catframes(stream, num_frames)
        for buffer in (ours, theirs):
            assert buffer.sample()["next", "history"].shape == (BATCH, num_frames, *shape)
        pairs = [
            (windows_per_second(ours.sample), windows_per_second(theirs.sample))
            for _ in range(REPEATS)
        ]
        ratios = [a / b for a, b in pairs]
        speeds = [list(column) for column in zip(*pairs, strict=True)]
        rows.append([case, spread(speeds[0]), spread(speeds[1]), spread(ratios, 1)])
        numbers[case] = {
            "our_windows_per_second": speeds[0],
            "catframes_windows_per_second": speeds[1],
            "ratios": ratios,
            "median_ratio": statistics.median(ratios),
        }
    markdown = (
        "# Histories cut from stored episodes\n\n"
        f"Batches of {BATCH} transitions with both histories; {REPEATS} rounds of {SECONDS:.0f} "
        "second each, alternating: median (range).\n\n"
        + table(["", "HistoryStorage", "CatFrames in a replay buffer", "ratio, pair by pair"], rows)
    )
    publish("history_windows", markdown, numbers, out)
