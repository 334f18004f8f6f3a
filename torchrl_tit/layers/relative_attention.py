"""Self-attention of Transformer-XL: positions enter as distances between steps."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


class RelativeSelfAttention(nn.Module):
    r"""Multi-head self-attention with relative position encodings.

    Step i weighs step j by the softmax over j of

    .. math:: ((q_i + u)^\top k_j + (q_i + v)^\top W_R R_{i-j}) / \sqrt{d}

    with sinusoids R of the distance and learned vectors u and v (arXiv 1901.02860, section 3.3;
    without the memory of earlier segments).

    Args:
        embed_dim: width D of a token.
        num_heads: number of heads; must divide ``embed_dim``.
        num_frames: number K of tokens, one for each frame.

    Raises:
        ValueError: if ``num_heads`` does not divide ``embed_dim``.

    Example:
        >>> attention = RelativeSelfAttention(embed_dim=32, num_heads=4, num_frames=5)
        >>> attention(torch.randn(8, 5, 32), causal=True).shape
        torch.Size([8, 5, 32])
    """

    distances: Tensor
    index: Tensor

    def __init__(self, embed_dim: int, num_heads: int, num_frames: int) -> None:
        super().__init__()
        if num_heads < 1 or embed_dim % num_heads:
            raise ValueError(
                f"the width {embed_dim} cannot be split over {num_heads} attention heads: "
                "choose a number of heads that divides embed_dim"
            )
        self.num_heads = num_heads
        self.head_dim = embed_dim // num_heads
        self.query_key_value = nn.Linear(embed_dim, 3 * embed_dim, bias=False)
        self.distance_key = nn.Linear(embed_dim, embed_dim, bias=False)  # W_R
        self.content_bias = nn.Parameter(torch.empty(num_heads, 1, self.head_dim))  # u
        self.distance_bias = nn.Parameter(torch.empty(num_heads, 1, self.head_dim))  # v
        self.out_proj = nn.Linear(embed_dim, embed_dim, bias=False)
        # Row d of the table is the distance d - (K - 1): from K - 1 steps ahead to K - 1 back.
        span = torch.arange(1 - num_frames, num_frames)
        self.register_buffer("distances", sinusoids(span, embed_dim), persistent=False)
        frames = torch.arange(num_frames)
        index = frames[:, None] - frames + num_frames - 1  # [K, K]
        self.register_buffer("index", index, persistent=False)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initialises u and v: zeros. The linear layers have their own."""
        nn.init.zeros_(self.content_bias)
        nn.init.zeros_(self.distance_bias)

    def forward(self, x: Tensor, *, causal: bool) -> Tensor:
        """Attends over the steps.

        Args:
            x: tokens, float [N, K, D].
            causal: whether a step sees only itself and earlier ones.

        Returns:
            float [N, K, D].
        """
        query, key, value = self._heads(x)
        mixed = self._weights(query, key, causal) @ value  # [N, heads, K, D / heads]
        return self.out_proj(mixed.transpose(1, 2).flatten(2))

    def weights(self, x: Tensor, *, causal: bool) -> Tensor:
        """Returns the attention weights, float [N, heads, K, K], rows (queries) summing to 1."""
        query, key, _ = self._heads(x)
        return self._weights(query, key, causal)

    def _heads(self, x: Tensor) -> tuple[Tensor, ...]:
        heads = self.query_key_value(x).unflatten(-1, (3, self.num_heads, self.head_dim))
        return heads.permute(2, 0, 3, 1, 4).unbind(0)  # [N, heads, K, D / heads] each

    def _weights(self, query: Tensor, key: Tensor, causal: bool) -> Tensor:
        distance_key = self.distance_key(self.distances.to(query.dtype))  # [2K - 1, D]
        distance_key = distance_key.unflatten(-1, (self.num_heads, -1)).permute(1, 2, 0)
        content = (query + self.content_bias) @ key.transpose(-2, -1)  # [N, heads, K, K]
        distance = (query + self.distance_bias) @ distance_key  # [N, heads, K, 2K - 1]
        distance = distance.gather(-1, self.index.expand(*content.shape[:-2], -1, -1))
        scores = (content + distance) / math.sqrt(self.head_dim)
        if causal:
            future = torch.ones_like(self.index, dtype=torch.bool).triu(1)
            scores = scores.masked_fill(future, -math.inf)
        return scores.softmax(dim=-1)


def sinusoids(positions: Tensor, dim: int) -> Tensor:
    """Encodes positions as sines and cosines of falling frequencies (arXiv 1706.03762).

    Args:
        positions: [P].
        dim: number of entries of an encoding.

    Returns:
        float32 [P, dim].

    Example:
        >>> sinusoids(torch.arange(2), 4)[0].tolist()
        [0.0, 0.0, 1.0, 1.0]
    """
    frequencies = 10_000 ** (-torch.arange(0, dim, 2) / dim)
    angles = positions[:, None] * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=-1)[:, :dim]
