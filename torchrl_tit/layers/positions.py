"""Positions that attention sees as distances between steps: a learned bias, or rotations."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class RelativeBias(nn.Module):
    """Adds a learned number to the attention score of two steps, for each head and distance.

    As in T5 (Raffel et al., arXiv 1910.10683, section 2.1), with a separate bias for every distance
    up to K - 1. The biases start at zero, so attention starts without positions.

    Args:
        num_heads: number of attention heads.
        num_frames: number K of steps.

    Example:
        >>> relative = RelativeBias(num_heads=2, num_frames=3)
        >>> _ = relative.bias.data.copy_(torch.tensor([[0.0, 1.0, 2.0], [0.0, -1.0, -2.0]]))
        >>> relative(3)[0].tolist()  # row sees column
        [[0.0, -inf, -inf], [1.0, 0.0, -inf], [2.0, 1.0, 0.0]]
        >>> relative.newest(3).tolist()
        [[2.0, 1.0, 0.0], [-2.0, -1.0, 0.0]]
    """

    def __init__(self, num_heads: int, num_frames: int) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.empty(num_heads, num_frames))  # entry d: d steps back
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initializes the biases with zeros."""
        nn.init.zeros_(self.bias)

    def forward(self, length: int) -> Tensor:
        """Returns the biases of all pairs of steps, minus infinity where a step is in the future.

        Args:
            length: number S <= K of steps.

        Returns:
            float [heads, S, S], to be added to the scores.

        Raises:
            ValueError: if there are more steps than biases.
        """
        # Each row is a part of (S - 1 back, ..., 1 back, 0 back, future, ..., future), the last row
        # the first part. Indexing would do the same, but its gradient takes longer.
        distances = F.pad(self.newest(length), (0, length - 1), value=-math.inf)
        return distances.unfold(-1, length, 1).flip(-2)

    def newest(self, length: int) -> Tensor:
        """Returns the biases of the newest of S steps, float [heads, S], the oldest step first."""
        check_length(length, self.bias.shape[-1])
        return self.bias[:, :length].flip(-1)

    def extra_repr(self) -> str:
        """Shows the number of heads and of distances."""
        return f"{self.bias.shape[0]}, {self.bias.shape[1]}"


class Rotary(nn.Module):
    """Rotates queries and keys by angles that grow with the step (RoPE).

    The score of two steps then depends on their contents and on the distance between them: with
    rotations R, (R_i q) . (R_j k) = q . (R_{j-i} k). Su et al., "RoFormer: Enhanced Transformer
    with Rotary Position Embedding", arXiv 2104.09864, section 3.2. Entry e is paired with entry
    e + d/2 of a head.

    Args:
        head_dim: entries d of a query or key of one head; even.
        num_frames: number K of steps.

    Raises:
        ValueError: if ``head_dim`` is odd.

    Example:
        >>> rotary = Rotary(head_dim=4, num_frames=3)
        >>> x = torch.randn(8, 2, 3, 4)  # of two heads
        >>> torch.allclose(rotary(x, length=3).norm(dim=-1), x.norm(dim=-1))
        True
    """

    cos: Tensor
    sin: Tensor

    def __init__(self, head_dim: int, num_frames: int) -> None:
        super().__init__()
        if head_dim % 2:
            raise ValueError(
                f"rotary positions turn pairs of entries, but a head has {head_dim}: choose a "
                "width that is an even multiple of num_heads, or other positions"
            )
        self.num_frames = num_frames
        sin, cos = sinusoids(torch.arange(num_frames), head_dim).chunk(2, dim=-1)
        self.register_buffer("cos", cos, persistent=False)  # [K, d / 2]
        self.register_buffer("sin", sin, persistent=False)

    def forward(self, x: Tensor, length: int, read: slice = slice(None)) -> Tensor:
        """Rotates queries or keys.

        Args:
            x: float [..., steps read, d].
            length: number S <= K of steps of the sequence.
            read: the steps that ``x`` holds.

        Returns:
            float [..., steps read, d].

        Raises:
            ValueError: if there are more than K steps.
        """
        check_length(length, self.num_frames)
        cos, sin = (table[:length][read].to(x.dtype) for table in (self.cos, self.sin))
        return _rotate(x, cos, sin)

    def at(self, x: Tensor, steps: Tensor) -> Tensor:
        """Rotates queries or keys of any steps.

        Args:
            x: float [..., d].
            steps: int64, broadcastable to [...].
        """
        angles = sinusoids(steps.flatten(), x.shape[-1]).view(*steps.shape, -1).to(x.dtype)
        sin, cos = angles.chunk(2, dim=-1)
        return _rotate(x, cos, sin)

    def at_each_distance(self, query: Tensor, key: Tensor) -> Tensor:
        """The products of queries and keys, were the key 0 to K - 1 steps back.

        Args:
            query: float [..., d].
            key: float [..., d].

        Returns:
            float [..., K], the largest distance first.
        """
        # With pairs of entries as complex numbers: the real part of conj(q) k exp(-i angle).
        (q1, q2), (k1, k2) = query.chunk(2, dim=-1), key.chunk(2, dim=-1)
        cos, sin = (table.flip(0).mT.to(query.dtype) for table in (self.cos, self.sin))
        return (q1 * k1 + q2 * k2) @ cos + (q1 * k2 - q2 * k1) @ sin

    def extra_repr(self) -> str:
        """Shows the number of entries and of steps."""
        return f"{2 * self.cos.shape[-1]}, {self.num_frames}"


def _rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotates pairs of entries, float [..., d], by angles with these cosines and sines."""
    first, second = x.chunk(2, dim=-1)
    return torch.cat([first * cos - second * sin, first * sin + second * cos], dim=-1)


def check_length(length: int, num_frames: int) -> None:
    """Raises ValueError if a sequence has more steps than there are positions."""
    if length > num_frames:
        raise ValueError(
            f"a sequence of {length} steps does not fit positions of {num_frames}: give it the "
            "last of them only"
        )


def sinusoids(positions: Tensor, dim: int) -> Tensor:
    """Encodes positions as sines and cosines of falling frequencies (arXiv 1706.03762).

    Args:
        positions: [P].
        dim: number of entries of an encoding.

    Returns:
        float [P, dim], of the default type, on the device of the positions: sines, then cosines.

    Example:
        >>> sinusoids(torch.arange(2), 4)[0].tolist()
        [0.0, 0.0, 1.0, 1.0]
    """
    frequencies = 10_000 ** (-torch.arange(0, dim, 2, device=positions.device) / dim)
    angles = positions[:, None] * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=-1)[:, :dim]
