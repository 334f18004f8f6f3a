"""Multi-head self-attention, plain and with relative positions, at the positions that are read."""

from __future__ import annotations

import math
from contextlib import ExitStack
from inspect import signature
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch._C._functorch import is_batchedtensor
from torch.nn import functional as F

from torchrl_tit.layers.positions import RelativeBias, Rotary, sinusoids
from torchrl_tit.settings.encoders import TemporalPositions

Read = Literal["all", "first", "last"]
"""Positions of a sequence that are read: all, the first (class token), the last (newest step)."""

READ_SLICES: dict[Read, slice] = {"all": slice(None), "first": slice(0, 1), "last": slice(-1, None)}


class _Heads(nn.Module):
    """What attention layers share: heads that divide the width."""

    def __init__(self, embed_dim: int, num_heads: int) -> None:
        super().__init__()
        if num_heads < 1 or embed_dim % num_heads:
            raise ValueError(
                f"the width {embed_dim} cannot be split over {num_heads} attention heads: "
                "choose a number of heads that divides embed_dim"
            )
        self.num_heads = num_heads

    def split_heads(self, x: Tensor) -> Tensor:
        """[..., S, D] -> [..., heads, S, D / heads]."""
        return x.unflatten(-1, (self.num_heads, -1)).transpose(-3, -2)


class SelfAttention(_Heads):
    """Multi-head scaled dot-product self-attention (arXiv 2212.14538, section "Inner Transformer").

    Has the same parameters, names and results as :class:`torch.nn.MultiheadAttention` with
    ``batch_first=True``, so that state dicts can be exchanged. Unlike there, queries are computed
    only for the positions that are read.

    Args:
        embed_dim: width D of a token.
        num_heads: number of heads; must divide ``embed_dim``.
        causal: whether a position sees only itself and earlier ones.
        dropout: probability of dropping an attention weight while training.
        out_dim: width of the output; by default the input's.
        positions: whether attention sees the distance between positions: "relative" (causal
            attention only) or "rotary". "learned" positions were added to the tokens, so here they
            are the same as "none".
        num_frames: number K of positions of the longest sequence, for "relative" and "rotary".

    Raises:
        ValueError: if ``num_heads`` does not divide ``embed_dim``, "rotary" heads have an odd
            number of entries, or "relative" attention is not causal.

    Example:
        >>> attention = SelfAttention(embed_dim=32, num_heads=4, causal=True)
        >>> x = torch.randn(8, 5, 32)
        >>> attention(x).shape, attention(x, read="last").shape
        (torch.Size([8, 5, 32]), torch.Size([8, 1, 32]))
    """

    def __init__(
        self,
        embed_dim: int,
        num_heads: int,
        *,
        causal: bool = False,
        dropout: float = 0.0,
        out_dim: int | None = None,
        positions: TemporalPositions = "none",
        num_frames: int = 1,
    ) -> None:
        super().__init__(embed_dim, num_heads)
        if positions == "relative" and not causal:
            raise ValueError("relative positions are distances to the past: choose causal=True")
        self.causal = causal
        self.in_proj_weight = nn.Parameter(torch.empty(3 * embed_dim, embed_dim))
        self.in_proj_bias = nn.Parameter(torch.empty(3 * embed_dim))
        self.out_proj = nn.Linear(embed_dim, out_dim or embed_dim)
        # A module, because TorchRL's losses look for nn.Dropout to set vmap's randomness.
        self.dropout = nn.Dropout(dropout)
        self.relative = RelativeBias(num_heads, num_frames) if positions == "relative" else None
        self.rotary = Rotary(embed_dim // num_heads, num_frames) if positions == "rotary" else None
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initializes as ``nn.MultiheadAttention`` does: Xavier for the input projections."""
        nn.init.xavier_uniform_(self.in_proj_weight)
        nn.init.zeros_(self.in_proj_bias)
        self.out_proj.reset_parameters()
        nn.init.zeros_(self.out_proj.bias)

    def forward(self, x: Tensor, read: Read | slice = "all", mask: Tensor | None = None) -> Tensor:
        """Attends over a sequence.

        Args:
            x: tokens, float [..., S, D].
            read: which positions to return, by name or as a slice of S.
            mask: bool, to be broadcast to [N, heads, S, S], where N is the product of the leading
                dimensions: True where a position (row) sees another (column). Each must see at
                least one. Replaces the causal mask, if any; "relative" positions keep it, as they
                have no bias for the future.

        Returns:
            float [..., positions read, D].
        """
        leading, x = x.shape[:-2], _flatten(x)  # [N, S, D], which PyTorch's kernels want
        positions = READ_SLICES[read] if isinstance(read, str) else read
        # The last position sees all others, so it needs no mask.
        causal = self.causal and mask is None and read != "last"
        if x.shape[1] == 1:
            mixed = self._attend_itself(x)
        elif (
            isinstance(read, str)
            and read != "all"
            and mask is None
            and not causal
            and self.rotary is None  # rotates each key by a different angle
        ):
            mixed = self._attend_one(x, positions)
        else:
            mixed = self._attend(x, positions, mask, causal)
        mixed = self.out_proj(mixed)  # [N, positions, out_dim]
        return mixed.reshape(*leading, *mixed.shape[1:])

    def weights(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        """Returns the attention weights, float [..., heads, S, S], rows (queries) summing to 1.

        Args:
            x: tokens, as in ``forward``.
            mask: as in ``forward``.
        """
        leading, x = x.shape[:-2], _flatten(x)
        query, key, _ = self._heads(x, READ_SLICES["all"])
        mask = self._mask(x, mask, self.causal and mask is None)
        weights = self._weights(query, key, mask)
        return weights.reshape(*leading, *weights.shape[1:])

    def window_scores(
        self, query: Tensor, key: Tensor, oldest_key: Tensor, back: Tensor, num_frames: int
    ) -> tuple[Tensor, Tensor]:
        """Scores of the newest frames of windows, for :func:`attend_windows`.

        Args:
            query: of the newest frames, float [N, heads, T, D / heads].
            key: of the rows of each sequence, float [N, heads, S, D / heads].
            oldest_key: of the oldest frames of the windows, of the shape of ``query``.
            back: how many steps a row is before a newest frame, int64 [N, T, S]; in the future, or
                more than K - 1, the score is not used.
            num_frames: number K of frames of a window.

        Returns:
            Scores with each row, float [N, heads, T, S], and with the oldest frame in the place of
            each of the K frames, float [N, heads, T, K].
        """
        query = query / math.sqrt(query.shape[-1])
        if self.rotary is None:
            scores = query @ key.mT
            padding = (query * oldest_key).sum(-1, keepdim=True).expand(-1, -1, -1, num_frames)
        else:
            steps = torch.arange(key.shape[-2], device=key.device)
            turned = self.rotary.at(query, back[:, None, :, 0])  # steps after the first row
            scores = turned @ self.rotary.at(key, steps).mT
            padding = self.rotary.at_each_distance(query, oldest_key)[..., -num_frames:]
        if self.relative is not None:
            bias = self.relative.bias.t()  # [K, heads]
            chosen = bias.index_select(0, back.clamp(0, num_frames - 1).flatten())
            scores = scores + chosen.view(*back.shape, self.num_heads).permute(0, 3, 1, 2)
            padding = padding + self.relative.newest(num_frames).unsqueeze(1)
        return scores, padding

    def extra_repr(self) -> str:
        """Shows the settings that the parameters' shapes do not."""
        return f"num_heads={self.num_heads}, causal={self.causal}"

    def project(self, x: Tensor, start: int, stop: int) -> Tensor:
        """Applies the projections from ``start`` to ``stop`` of (query, key, value) at once."""
        rows = slice(start * x.shape[-1], stop * x.shape[-1])
        return F.linear(x, self.in_proj_weight[rows], self.in_proj_bias[rows])

    def _attend(self, x: Tensor, positions: slice, mask: Tensor | None, causal: bool) -> Tensor:
        """The output of attention at these positions, float [N, positions, D]."""
        query, key, value = self._heads(x, positions)  # [N, heads, positions or S, D / heads]
        everything = positions == READ_SLICES["all"]
        # PyTorch's kernel for CPUs has no gradient for a bias added to the scores.
        products = self._drops or self.relative is not None or _has_no_kernel(query)
        fused = causal and everything and not products
        if not fused:
            mask = self._mask(x, mask, causal)
        if mask is not None:
            mask = mask[..., positions, :]
        if products:
            mixed = self.dropout(self._weights(query, key, mask)) @ value
        else:
            mixed = F.scaled_dot_product_attention(query, key, value, mask, is_causal=fused)
        return mixed.transpose(1, 2).flatten(2)

    def _attend_itself(self, x: Tensor) -> Tensor:
        """Like ``_attend``, for a sequence of one: its softmax is 1, so only the value is left."""
        value = self.project(x, 2, 3)  # [N, 1, D]
        if not self._drops:
            return value
        ones = x.new_ones(x.shape[0], 1, self.num_heads, 1)
        return (self.dropout(ones) * value.unflatten(-1, (self.num_heads, -1))).flatten(2)

    def _attend_one(self, x: Tensor, position: slice) -> Tensor:
        """Like ``_attend``, for one position that sees all others, float [N, 1, D].

        No keys or values are computed, because projections are linear:

            q . (W x_i + b) = (W^T q) . x_i + q . b,  and the softmax ignores what all i share,
            sum_i a_i (W x_i + b) = W (sum_i a_i x_i) + b,  as the a_i sum to 1.

        So the weights of keys and values are applied once per head, not to each of the S tokens.
        """
        if self._drops:  # with dropout, the weights do not sum to 1
            return self._attend(x, position, None, causal=False)
        weights = self.in_proj_weight.unflatten(0, (3, self.num_heads, -1))
        query_weight, key_weight, value_weight = weights.unbind()  # [heads, D / heads, D] each
        biases = self.in_proj_bias.unflatten(0, (3, self.num_heads, 1, -1))
        query_bias, _, value_bias = biases.unbind()  # [heads, 1, D / heads] each
        one = x[:, position].transpose(0, 1).expand(self.num_heads, -1, -1)  # [heads, N, D]
        query = torch.baddbmm(query_bias, one, query_weight.mT)  # [heads, N, D / heads]
        scale = query.shape[-1] ** -0.5
        # The heads take the place of the positions: all read the same tokens.
        query = torch.bmm(query, key_weight).transpose(0, 1).unsqueeze(1)  # [N, 1, heads, D]
        tokens = x.unsqueeze(1)
        if self.relative is None and not _has_no_kernel(query):
            mixed = F.scaled_dot_product_attention(query, tokens, tokens, scale=scale)
        else:
            scores = query @ tokens.mT * scale
            if self.relative is not None:
                scores = scores + self.relative.newest(x.shape[1])
            mixed = scores.softmax(dim=-1) @ tokens
        value = torch.baddbmm(value_bias, mixed.squeeze(1).transpose(0, 1), value_weight.mT)
        return value.transpose(0, 1).flatten(1).unsqueeze(1)

    @property
    def _drops(self) -> bool:
        """Whether attention weights are dropped."""
        return self.training and self.dropout.p > 0

    def _heads(self, x: Tensor, positions: slice) -> tuple[Tensor, Tensor, Tensor]:
        """Queries of the positions, keys and values of all, [N, heads, ..., D / heads] each."""
        if positions == READ_SLICES["all"]:
            query, key, value = self.project(x, 0, 3).chunk(3, dim=-1)
        else:
            query = self.project(x[:, positions], 0, 1)
            key, value = self.project(x, 1, 3).chunk(2, dim=-1)
        query, key, value = self.split_heads(query), self.split_heads(key), self.split_heads(value)
        if self.rotary is None:
            return query, key, value
        length = x.shape[1]
        return self.rotary(query, length, positions), self.rotary(key, length), value

    def _mask(self, x: Tensor, mask: Tensor | None, causal: bool) -> Tensor | None:
        """The bias added to the scores, float [..., S, S], or their mask, bool [..., S, S].

        None if all scores are used unchanged.
        """
        if self.relative is None and not causal:
            return mask
        if self.relative is None:
            return torch.ones(x.shape[1], x.shape[1], dtype=torch.bool, device=x.device).tril()
        bias = self.relative(x.shape[1])
        return bias if mask is None else bias.masked_fill(~mask, -math.inf)

    def _weights(self, query: Tensor, key: Tensor, mask: Tensor | None) -> Tensor:
        scores = query @ key.transpose(-2, -1) / math.sqrt(query.shape[-1])
        if mask is not None:
            boolean = mask.dtype == torch.bool
            scores = scores.masked_fill(~mask, -math.inf) if boolean else scores + mask
        return scores.softmax(dim=-1)


class RelativeSelfAttention(_Heads):
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

    def __init__(self, embed_dim: int, num_heads: int, num_frames: int) -> None:
        super().__init__(embed_dim, num_heads)
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
        """Initializes u and v with zeros. The linear layers initialize themselves."""
        nn.init.zeros_(self.content_bias)
        nn.init.zeros_(self.distance_bias)

    def forward(self, x: Tensor, *, causal: bool, read: Read = "all") -> Tensor:
        """Attends over the steps.

        Args:
            x: tokens, float [..., K, D].
            causal: whether a step sees only itself and earlier ones.
            read: which steps to compute and return: all, the first or the last.

        Returns:
            float [..., K or 1, D].
        """
        query, key, value = self._heads(x, read)
        mixed = self._weights(query, key, causal, read) @ value  # [..., heads, steps, D / heads]
        return self.out_proj(mixed.transpose(-3, -2).flatten(-2))

    def weights(self, x: Tensor, *, causal: bool) -> Tensor:
        """Returns the attention weights, float [..., heads, K, K], rows (queries) summing to 1.

        Args:
            x: as in ``forward``.
            causal: as in ``forward``.
        """
        query, key, _ = self._heads(x, "all")
        return self._weights(query, key, causal, "all")

    def _heads(self, x: Tensor, read: Read) -> list[Tensor]:
        """Queries of the steps read, keys and values of all, [..., heads, steps, D / heads]."""
        if read == "all":
            heads = self.project(x, 0, 3).chunk(3, dim=-1)
        else:
            query = self.project(x[..., READ_SLICES[read], :], 0, 1)
            heads = (query, *self.project(x, 1, 3).chunk(2, dim=-1))
        return [self.split_heads(y) for y in heads]

    def project(self, x: Tensor, start: int, stop: int) -> Tensor:
        """Applies the projections from ``start`` to ``stop`` of (query, key, value) at once."""
        return F.linear(x, self.query_key_value.weight[start * x.shape[-1] : stop * x.shape[-1]])

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
        """Products (q + v) . W_R R, [..., heads, S, 2K - 1]: from K - 1 ahead to K - 1 back."""
        key = self.distance_key(self.distances.to(query.dtype))  # [2K - 1, D]
        key = key.unflatten(-1, (self.num_heads, -1)).permute(1, 2, 0)
        return (query + self.distance_bias) @ key

    def _weights(self, query: Tensor, key: Tensor, causal: bool, read: Read) -> Tensor:
        rows = READ_SLICES[read]
        content = (query + self.content_bias) @ key.mT  # [..., heads, steps, K]
        distance = self._distance_scores(query)  # [..., heads, steps, 2K - 1]
        distance = distance.gather(-1, self.index[rows].expand(*content.shape[:-2], -1, -1))
        scores = (content + distance) / math.sqrt(self.head_dim)
        if causal:
            future = torch.ones_like(self.index, dtype=torch.bool).triu(1)[rows]
            scores = scores.masked_fill(future, -math.inf)
        return scores.softmax(dim=-1)


def _has_no_kernel(query: Tensor) -> bool:
    """Whether PyTorch's attention has no gradient: in vmap on a GPU (pytorch/pytorch#191085)."""
    return query.is_cuda and is_batchedtensor(query)


def _flatten(x: Tensor) -> Tensor:
    """[..., S, D] -> [N, S, D], also without leading dimensions or entries."""
    return x.reshape(math.prod(x.shape[:-2]), *x.shape[-2:])


def attention_maps(module: nn.Module, *inputs: Tensor) -> list[Tensor]:
    """Calls a module, and returns the weights of its attention layers in the order of their calls.

    This is slower than a plain call, which does not compute all attention weights.

    Args:
        module: any module; the attention layers in it are found.
        *inputs: what it reads.

    Returns:
        float [..., heads, S, S] of each call of a layer, rows (queries) summing to 1.

    Example:
        >>> (weights,) = attention_maps(SelfAttention(32, 4), torch.randn(8, 5, 32))
        >>> weights.shape
        torch.Size([8, 4, 5, 5])
    """
    maps: list[Tensor] = []

    def record(layer: nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        assert isinstance(layer, SelfAttention | RelativeSelfAttention)
        given = signature(layer.forward).bind(*args, **kwargs).arguments
        given.pop("read", None)  # the weights of all positions are returned
        maps.append(layer.weights(**given))

    with ExitStack() as hooks:
        for layer in module.modules():
            if isinstance(layer, SelfAttention | RelativeSelfAttention):
                handle = layer.register_forward_pre_hook(record, with_kwargs=True)
                hooks.callback(handle.remove)
        module(*inputs)
    return maps
