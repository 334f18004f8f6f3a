"""The networks that are measured: ours, and the same one written straightforwardly."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from torch import nn

from torchrl_tit import EnhancedTIT, VanillaTIT
from torchrl_tit.networks import EnhancedTITConfig, HistoryNetwork, VanillaTITConfig

from .straightforward import StraightforwardTIT


@dataclass(frozen=True)
class Case:
    """A network and what it is given; the defaults of images are those of the paper's Atari."""

    variant: Literal["Enhanced", "Vanilla"]
    inputs: Literal["arrays", "images"]
    history: int
    batch: int

    @property
    def observation_shape(self) -> tuple[int, ...]:
        """Four entries as in CartPole, or an Atari picture."""
        return (4,) if self.inputs == "arrays" else (84, 84)

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes of the network."""
        if self.inputs == "arrays":
            return {"patch": 1, "width": 32, "heads": 1, "blocks": 2, "features": 64}
        return {"patch": 12, "width": 64, "heads": 4, "blocks": 2, "features": 512}

    def ours(self) -> HistoryNetwork:
        """Our network, without dropout."""
        kind = EnhancedTITConfig if self.variant == "Enhanced" else VanillaTITConfig
        sizes = self.sizes
        config: Any = kind(
            patch_size=sizes["patch"],
            embed_dim=sizes["width"],
            num_heads_inner=sizes["heads"],
            num_heads_outer=sizes["heads"],
            num_blocks=sizes["blocks"],
            features_dim=sizes["features"],
            activation_head="tanh" if self.inputs == "arrays" else "gelu",
        )
        build: Any = EnhancedTIT if self.variant == "Enhanced" else VanillaTIT
        return build(self.observation_shape, self.history, config)

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
        """What a row of a table says of it."""
        sizes = [self.sizes[name] for name in ("patch", "width", "heads", "blocks")]
        return [self.variant, self.inputs, self.history, *sizes, self.batch]

    def record(self) -> dict[str, Any]:
        """The same for JSON."""
        return {**asdict(self), **self.sizes}


COLUMNS = ["variant", "inputs", "K", "patch", "width", "heads", "blocks", "batch"]


def same_number_of_weights(case: Case) -> bool:
    """Whether both networks of a case are the same size."""
    counts = [
        sum(p.numel() for p in network.parameters())
        for network in (case.ours(), case.straightforward())
    ]
    return counts[0] == counts[1]
