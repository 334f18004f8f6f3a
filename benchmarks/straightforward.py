"""The networks that benchmarks measure: ours, and straightforward ones on nn.MultiheadAttention.

Every block of a straightforward network computes every token of every frame of the window.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from torchrl_tit import EnhancedTIT, VanillaTIT
from torchrl_tit.networks import HistoryNetwork


class Block(nn.Module):
    """Pre-LayerNorm transformer block on ``nn.MultiheadAttention``."""

    def __init__(self, width: int, heads: int, expansion: int, causal: bool) -> None:
        super().__init__()
        self.norm1, self.norm2 = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention = nn.MultiheadAttention(width, heads, batch_first=True)
        self.ffn = nn.Sequential(
            nn.Linear(width, expansion * width), nn.GELU(), nn.Linear(expansion * width, width)
        )
        self.causal = causal

    def forward(self, x: Tensor) -> Tensor:
        steps = x.shape[1]
        mask = (
            torch.full((steps, steps), float("-inf"), device=x.device).triu(1)
            if self.causal
            else None
        )
        y = self.norm1(x)
        x = x + self.attention(y, y, y, attn_mask=mask, need_weights=False)[0]
        return x + self.ffn(self.norm2(x))


class StraightforwardTIT(nn.Module):
    """TIT on arrays [B, K, D] (patch 1) or images [B, K, H, W]: Enhanced, or Vanilla."""

    def __init__(
        self,
        observation_shape: tuple[int, ...],
        *,
        patch_size: int = 1,
        embed_dim: int = 32,
        num_blocks: int = 2,
        num_heads: int = 1,
        expansion: int = 4,
        features_dim: int = 64,
        head: type[nn.Module] = nn.Tanh,
        enhanced: bool = True,
    ) -> None:
        super().__init__()
        self.enhanced = enhanced
        convolution = nn.Conv1d if len(observation_shape) == 1 else nn.Conv2d
        self.patches = convolution(1, embed_dim, patch_size, patch_size, bias=False)
        num_patches = 1
        for size in observation_shape:
            num_patches *= size // patch_size
        self.class_token = nn.Parameter(0.02 * torch.randn(1, 1, embed_dim))
        self.positions = nn.Parameter(0.02 * torch.randn(1, num_patches + 1, embed_dim))
        self.inner = nn.ModuleList(
            Block(embed_dim, num_heads, expansion, False) for _ in range(num_blocks)
        )
        self.outer = nn.ModuleList(
            Block(embed_dim, num_heads, expansion, True) for _ in range(num_blocks)
        )
        width = num_blocks * embed_dim if enhanced else embed_dim
        self.head = nn.Sequential(
            nn.LayerNorm(width),
            nn.Linear(width, features_dim),
            head(),
            nn.LayerNorm(features_dim),
        )

    def forward(self, history: Tensor) -> Tensor:
        if history.dtype == torch.uint8:
            history = history.float() / 255
        batch, steps = history.shape[:2]
        x = self.patches(history.flatten(0, 1).unsqueeze(1)).flatten(2).transpose(1, 2)
        x = torch.cat([self.class_token.expand(len(x), -1, -1), x], dim=1) + self.positions
        outputs = []
        for inner, outer in zip(self.inner, self.outer, strict=True):
            x = inner(x)  # [B * K, 1 + patches, D]
            if self.enhanced:
                outputs.append(outer(x[:, 0].unflatten(0, (batch, steps)))[:, -1])
        if not self.enhanced:
            x = x[:, 0].unflatten(0, (batch, steps))
            for outer in self.outer:
                x = outer(x)  # [B, K, D]
            outputs.append(x[:, -1])
        return self.head(torch.cat(outputs, dim=-1))


@dataclass(frozen=True)
class Case:
    """A network and its inputs: four entries as in CartPole, or the paper's Atari images."""

    variant: Literal["Enhanced", "Vanilla"]
    inputs: Literal["arrays", "images"]
    num_frames: int
    batch: int

    @property
    def observation_shape(self) -> tuple[int, ...]:
        return (4,) if self.inputs == "arrays" else (84, 84)

    @property
    def sizes(self) -> dict[str, int]:
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
        """The same network, with as many weights."""
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

    def frames(self, steps: int) -> Tensor:
        """Random observations, [batch, steps, *observation_shape]."""
        shape = (self.batch, steps, *self.observation_shape)
        if self.inputs == "images":
            return torch.randint(0, 256, shape, dtype=torch.uint8)
        return torch.randn(shape)

    def record(self) -> dict[str, Any]:
        """The case for JSON."""
        return {**asdict(self), **self.sizes}
