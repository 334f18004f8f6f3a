"""Bytes of each stored transition: frames stored once, compared with stacked histories.

``HistoryStorage`` stores each observation once and cuts histories when they are sampled. A buffer
of stacked frames stores the history of the observation and that of the next one.
"""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_tit.datasets import HistoryStorage, episodes_from_arrays

from .history_windows import make_stream
from .report import publish, table

STEPS = 1000
CASES = {
    "arrays of 11": ((11,), torch.float32),
    "84 x 84 images": ((84, 84), torch.uint8),
}


def bytes_of(data: TensorDict) -> int:
    """Counts the bytes of all tensors; shared memory counts once."""
    storages = {
        value.untyped_storage().data_ptr(): value.untyped_storage().nbytes()
        for value in data.values(include_nested=True, leaves_only=True)
    }
    return sum(storages.values())


def stacked_bytes(stream: dict[str, torch.Tensor], num_frames: int) -> float:
    """Measures the bytes of a transition in a buffer of stacked frames."""
    steps = len(stream["rewards"])
    index = (torch.arange(steps).unsqueeze(1) - torch.arange(num_frames - 1, -1, -1)).clamp(min=0)
    ends = stream["terminals"].unsqueeze(-1)
    data = TensorDict(
        {
            "history": stream["observations"][index],
            "action": stream["actions"],
            "next": {
                "history": stream["next_observations"][index],
                "reward": stream["rewards"].unsqueeze(-1),
                "done": ends,
                "terminated": ends,
            },
        },
        [steps],
    )
    storage = LazyTensorStorage(steps)
    storage.set(range(steps), data)
    return bytes_of(storage._storage) / steps


def our_bytes(stream: dict[str, torch.Tensor], num_frames: int) -> float:
    """Measures the bytes of a transition in our storage, including the index of windows."""
    episodes = episodes_from_arrays(**stream)
    storage = HistoryStorage(episodes, num_frames)
    tensors = [value for value in vars(storage).values() if isinstance(value, torch.Tensor)]
    index = sum(tensor.untyped_storage().nbytes() for tensor in tensors)
    return (bytes_of(episodes.rows) + index) / len(stream["rewards"])


def main(out: Path | None) -> None:
    """Fills real storages and reports."""
    rows, numbers = [], {}
    for name, (shape, dtype) in CASES.items():
        stream = make_stream(shape, dtype, STEPS)
        for num_frames in (1, 4, 16, 64):
            ours, stacked = our_bytes(stream, num_frames), stacked_bytes(stream, num_frames)
            ratio = f"{stacked / ours:.1f}"
            rows.append([name, num_frames, f"{ours:.0f}", f"{stacked:.0f}", ratio])
            numbers[f"{name}, K = {num_frames}"] = {"ours": ours, "stacked": stacked}
    markdown = f"# Memory\n\nBytes of each of {STEPS} stored transitions.\n\n" + table(
        ["", "K", "HistoryStorage", "stacked frames", "ratio"], rows
    )
    publish("memory", markdown, numbers, out)
