"""Histories sampled per second: HistoryStorage compared with a replay buffer with CatFrames.

Both sample batches of 256 transitions, with the histories of the observation and of the next one,
from the same episodes in memory, on one thread, alternating. CatFrames' sampler draws whole slices
of K transitions and stacks within them, so it never samples the first K - 1 steps of an episode.
Beside it, the bytes of a stored transition: ours stores each observation once.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs.transforms import CatFrames, Compose, UnsqueezeTransform

from torchrl_tit.datasets import HistoryStorage, episodes_from_arrays, make_replay_buffer

from .measuring import ratios, take_turns

BATCH, ROUNDS, SECONDS = 256, 5, 1.0
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


def bytes_of(tensors: Iterable[torch.Tensor]) -> int:
    """Counts the bytes of tensors; shared memory counts once."""
    storages = (tensor.untyped_storage() for tensor in tensors)
    return sum({storage.data_ptr(): storage.nbytes() for storage in storages}.values())


def bytes_per_step(stream: dict[str, torch.Tensor], num_frames: int) -> tuple[float, float]:
    """Measures the bytes of a stored transition: ours, and where histories are stored stacked."""
    steps = len(stream["rewards"])
    episodes = episodes_from_arrays(**stream)
    storage = HistoryStorage(episodes, num_frames)
    index = [value for value in vars(storage).values() if isinstance(value, torch.Tensor)]
    ours = bytes_of([*episodes.rows.values(include_nested=True, leaves_only=True), *index])
    others = [stream[name] for name in ("actions", "rewards", "terminals", "terminals")]
    frame = stream["observations"][0].nbytes
    stacked = 2 * num_frames * frame + sum(tensor[0].nbytes for tensor in others)
    return ours / steps, stacked


def main() -> dict[str, Any]:
    """Measures transitions per second, alternating."""
    numbers = {}
    for case, (shape, dtype, steps, num_frames) in CASES.items():
        torch.manual_seed(0)
        stream = make_stream(shape, dtype, steps)
        ours, theirs = make_ours(stream, num_frames), make_catframes(stream, num_frames)
        for buffer in (ours, theirs):
            assert buffer.sample()["next", "history"].shape == (BATCH, num_frames, *shape)
        times = take_turns({"ours": ours.sample, "theirs": theirs.sample}, ROUNDS, SECONDS)
        speeds = [[1000 * BATCH / one for one in times[name]] for name in ("ours", "theirs")]
        sizes = bytes_per_step(stream, num_frames)
        numbers[case] = {
            "our_windows_per_second": speeds[0],
            "catframes_windows_per_second": speeds[1],
            "median_ratio": statistics.median(ratios(*speeds)),
            "bytes": {"ours": sizes[0], "stacked": sizes[1]},
        }
    return numbers
