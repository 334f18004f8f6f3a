"""The networks that the benchmarks measure: ours, and straightforward implementations of them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from torch import nn

from torchrl_tit import EnhancedTIT, VanillaTIT
from torchrl_tit.networks import HistoryNetwork

from .straightforward import StraightforwardTIT


@dataclass(frozen=True)
class Case:
    """A network and its inputs; the sizes for images are those of the paper's Atari runs."""

    variant: Literal["Enhanced", "Vanilla"]
    inputs: Literal["arrays", "images"]
    num_frames: int
    batch: int

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """Four entries as in CartPole, or an Atari image."""
        return (4,) if self.inputs == "arrays" else (84, 84)

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes of the network."""
        if self.inputs == "arrays":
            return {"patch": 1, "width": 32, "heads": 1, "blocks": 2, "features": 64}
        return {"patch": 12, "width": 64, "heads": 4, "blocks": 2, "features": 512}

    def ours(self) -> HistoryNetwork:
        """Our network, without dropout."""
        build = EnhancedTIT if self.variant == "Enhanced" else VanillaTIT
        sizes = self.sizes
        return build(
            self.observation_shape,
            self.num_frames,
            patch_size=sizes["patch"],
            embed_dim=sizes["width"],
            num_heads_inner=sizes["heads"],
            num_heads_outer=sizes["heads"],
            num_blocks=sizes["blocks"],
            features_dim=sizes["features"],
            activation_head="tanh" if self.inputs == "arrays" else "gelu",
        )

    def straightforward(self) -> StraightforwardTIT:
        """The same network on ``nn.MultiheadAttention``."""
        sizes = self.sizes
        return StraightforwardTIT(
            self.observation_shape,
            patch_size=sizes["patch"],
            embed_dim=sizes["width"],
            num_heads=sizes["heads"],
            num_blocks=sizes["blocks"],
            features_dim=sizes["features"],
            head=nn.Tanh if self.inputs == "arrays" else nn.GELU,
            enhanced=self.variant == "Enhanced",
        )

    def frames(self, steps: int) -> torch.Tensor:
        """Random observations, [batch, steps, *observation_shape]."""
        shape = (self.batch, steps, *self.observation_shape)
        if self.inputs == "images":
            return torch.randint(0, 256, shape, dtype=torch.uint8)
        return torch.randn(shape)

    def columns(self) -> list[object]:
        """The case as the first cells of a table row."""
        sizes = [self.sizes[name] for name in ("patch", "width", "heads", "blocks")]
        return [self.variant, self.inputs, self.num_frames, *sizes, self.batch]

    def record(self) -> dict[str, Any]:
        """The case for JSON."""
        return {**asdict(self), **self.sizes}


COLUMNS = ["variant", "inputs", "K", "patch", "width", "heads", "blocks", "batch"]


def same_number_of_weights(case: Case) -> bool:
    """Whether both networks of a case have the same number of weights."""
    counts = [
        sum(p.numel() for p in network.parameters())
        for network in (case.ours(), case.straightforward())
    ]
    return counts[0] == counts[1]
