"""Straightforward implementations of both TITs, on nn.MultiheadAttention.

Every block computes every token of every frame of the window.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn


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
