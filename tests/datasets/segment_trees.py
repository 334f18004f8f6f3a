"""Plain segment trees, in place of those of TorchRL's extension where that does not load."""

from typing import Any

import pytest
import torch
from torch import Tensor
from torchrl.data.replay_buffers.samplers import prioritized


class PlainTree:
    """Values, all of them looked at by each query."""

    def __init__(self, capacity: int, empty: float) -> None:
        self.values = torch.full((capacity,), empty)

    def __getitem__(self, index: Any) -> Tensor:
        return self.values[index]

    def __setitem__(self, index: Any, value: Any) -> None:
        self.values[index] = torch.as_tensor(value, dtype=torch.float)


class SumTree(PlainTree):
    def __init__(self, capacity: int) -> None:
        super().__init__(capacity, 0.0)

    def query(self, begin: int, stop: int) -> float:
        return self.values[begin:stop].sum().item()

    def scan_lower_bound(self, mass: Any) -> Tensor:
        return torch.searchsorted(self.values.cumsum(0), torch.as_tensor(mass).float())


class MinTree(PlainTree):
    def __init__(self, capacity: int) -> None:
        super().__init__(capacity, torch.inf)

    def query(self, begin: int, stop: int) -> float:
        return self.values[begin:stop].min().item()


def provide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets `PrioritizedSampler` be made."""
    if prioritized.SumSegmentTreeFp32 is None:
        for precision in ("Fp32", "Fp64"):
            monkeypatch.setattr(prioritized, f"SumSegmentTree{precision}", SumTree)
            monkeypatch.setattr(prioritized, f"MinSegmentTree{precision}", MinTree)
