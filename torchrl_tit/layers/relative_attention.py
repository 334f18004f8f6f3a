"""Self-attention of Transformer-XL, where positions are distances between steps."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from torchrl_tit.layers.attention import READ_SLICES, Read
from torchrl_tit.layers.positions import sinusoids
from torchrl_tit.settings.arguments import checked_arguments
from torchrl_tit.settings.numbers import Count, Frames, Width


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
        >>> x = torch.randn(8, 5, 32)
        >>> attention(x, causal=True).shape, attention(x, causal=True, read="last").shape
        (torch.Size([8, 5, 32]), torch.Size([8, 1, 32]))
    """

    distances: Tensor
    index: Tensor

    @checked_arguments
    def __init__(self, embed_dim: Width, num_heads: Count, num_frames: Frames) -> None:
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
        """Initialises u and v with zeros. The linear layers initialise themselves."""
        nn.init.zeros_(self.content_bias)
        nn.init.zeros_(self.distance_bias)

    def forward(self, x: Tensor, *, causal: bool, read: Read = "all") -> Tensor:
        """Attends over the steps.

        Args:
            x: tokens, float [N, K, D].
            causal: whether a step sees only itself and earlier ones.
            read: which steps to compute and return: all, the first or the last.

        Returns:
            float [N, K or 1, D].
        """
        query, key, value = self._heads(x, read)
        mixed = self._weights(query, key, causal, read) @ value  # [N, heads, steps, D / heads]
        return self.out_proj(mixed.transpose(1, 2).flatten(2))

    def weights(self, x: Tensor, *, causal: bool) -> Tensor:
        """Returns the attention weights, float [N, heads, K, K], rows (queries) summing to 1."""
        query, key, _ = self._heads(x, "all")
        return self._weights(query, key, causal, "all")

    def _heads(self, x: Tensor, read: Read) -> list[Tensor]:
        """Queries of the steps read, keys and values of all, [N, heads, ..., D / heads] each."""
        if read == "all":
            heads = self.query_key_value(x).chunk(3, dim=-1)
        else:
            width = x.shape[-1]
            weight = self.query_key_value.weight
            query = F.linear(x[:, READ_SLICES[read]], weight[:width])
            heads = (query, *F.linear(x, weight[width:]).chunk(2, dim=-1))
        return [y.unflatten(-1, (self.num_heads, -1)).transpose(1, 2) for y in heads]

    def _weights(self, query: Tensor, key: Tensor, causal: bool, read: Read) -> Tensor:
        rows = READ_SLICES[read]
        distance_key = self.distance_key(self.distances.to(query.dtype))  # [2K - 1, D]
        distance_key = distance_key.unflatten(-1, (self.num_heads, -1)).permute(1, 2, 0)
        content = (query + self.content_bias) @ key.transpose(-2, -1)  # [N, heads, steps, K]
        distance = (query + self.distance_bias) @ distance_key  # [N, heads, steps, 2K - 1]
        distance = distance.gather(-1, self.index[rows].expand(*content.shape[:-2], -1, -1))
        scores = (content + distance) / math.sqrt(self.head_dim)
        if causal:
            future = torch.ones_like(self.index, dtype=torch.bool).triu(1)[rows]
            scores = scores.masked_fill(future, -math.inf)
        return scores.softmax(dim=-1)
