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
            heads = self.project(x, 0, 3).chunk(3, dim=-1)
        else:
            query = self.project(x[:, READ_SLICES[read]], 0, 1)
            heads = (query, *self.project(x, 1, 3).chunk(2, dim=-1))
        return [self.split_heads(y) for y in heads]

    def project(self, x: Tensor, start: int, stop: int) -> Tensor:
        """Applies the projections from ``start`` to ``stop`` of (query, key, value) at once."""
        return F.linear(x, self.query_key_value.weight[start * x.shape[-1] : stop * x.shape[-1]])

    def split_heads(self, x: Tensor) -> Tensor:
        """[N, S, D] -> [N, heads, S, D / heads]."""
        return x.unflatten(-1, (self.num_heads, -1)).transpose(1, 2)

    def window_scores(
        self, query: Tensor, key: Tensor, oldest_key: Tensor, back: Tensor, num_frames: int
    ) -> tuple[Tensor, Tensor]:
        """Scores of the newest frames of windows: see :meth:`SelfAttention.window_scores`."""
        scale = 1 / math.sqrt(self.head_dim)
        distance = self._distance_scores(query)[..., num_frames - 1 :] * scale  # 0 to K - 1 back
        content = (query + self.content_bias) * scale
        index = back.clamp(0, num_frames - 1).unsqueeze(1).expand(-1, self.num_heads, -1, -1)
        scores = content @ key.mT + distance.gather(-1, index)
        return scores, (content * oldest_key).sum(-1, keepdim=True) + distance.flip(-1)

    def _distance_scores(self, query: Tensor) -> Tensor:
        """Products (q + v) . W_R R, float [N, heads, S, 2K - 1]: from K - 1 ahead to K - 1 back."""
        key = self.distance_key(self.distances.to(query.dtype))  # [2K - 1, D]
        key = key.unflatten(-1, (self.num_heads, -1)).permute(1, 2, 0)
        return (query + self.distance_bias) @ key

    def _weights(self, query: Tensor, key: Tensor, causal: bool, read: Read) -> Tensor:
        rows = READ_SLICES[read]
        content = (query + self.content_bias) @ key.transpose(-2, -1)  # [N, heads, steps, K]
        distance = self._distance_scores(query)  # [N, heads, steps, 2K - 1]
        distance = distance.gather(-1, self.index[rows].expand(*content.shape[:-2], -1, -1))
        scores = (content + distance) / math.sqrt(self.head_dim)
        if causal:
            future = torch.ones_like(self.index, dtype=torch.bool).triu(1)[rows]
            scores = scores.masked_fill(future, -math.inf)
        return scores.softmax(dim=-1)
