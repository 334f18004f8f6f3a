"""The transformer block of the inner and outer transformers."""

from __future__ import annotations

from torch import Tensor, nn

from torchrl_tit.layers.activations import make_activation
from torchrl_tit.layers.attention import READ_SLICES, Read, SelfAttention
from torchrl_tit.layers.window_attention import attend_windows
from torchrl_tit.settings.arguments import checked_arguments
from torchrl_tit.settings.frames import Activation, TransformerSettings
from torchrl_tit.settings.histories import TemporalPositions
from torchrl_tit.settings.numbers import Count, Probability, Width
from torchrl_tit.windows import Windows


class TransformerBlock(nn.Module):
    """Pre-LayerNorm transformer block: ``x + MSA(LN(x))``, then ``x + FFN(LN(x))``.

    The paper's FFN equation adds the block's input again (arXiv 2212.14538, eq. of step 5); its
    released code adds the residual of the attention output, as is usual, and so does this block.

    Args:
        embed_dim: width D of a token.
        num_heads: attention heads; must divide ``embed_dim``.
        ffn_expansion: hidden width of the FFN as a multiple of ``embed_dim``.
        activation: activation of the FFN by name.
        attention_dropout: dropout on the attention weights.
        ffn_dropout: dropout on the output of the FFN.
        causal: whether a position sees only itself and earlier ones.
        positions: whether attention sees distances: see :class:`SelfAttention`.
        num_frames: number K of positions of the longest sequence, if it does.

    Example:
        >>> import torch
        >>> block = TransformerBlock(embed_dim=32, num_heads=4, ffn_expansion=4)
        >>> block(torch.randn(8, 5, 32), read="first").shape
        torch.Size([8, 1, 32])
    """

    @checked_arguments
    def __init__(
        self,
        embed_dim: Width,
        num_heads: Count,
        *,
        ffn_expansion: Count = 4,
        activation: Activation = "gelu",
        attention_dropout: Probability = 0.0,
        ffn_dropout: Probability = 0.0,
        causal: bool = False,
        positions: TemporalPositions = "none",
        num_frames: int = 1,
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(embed_dim)
        self.attention = SelfAttention(
            embed_dim,
            num_heads,
            causal=causal,
            dropout=attention_dropout,
            positions=positions,
            num_frames=num_frames,
        )
        self.norm2 = nn.LayerNorm(embed_dim)
        self.ffn = nn.Sequential(
            nn.Linear(embed_dim, ffn_expansion * embed_dim),
            make_activation(activation),
            nn.Linear(ffn_expansion * embed_dim, embed_dim),
            nn.Dropout(ffn_dropout),
        )

    @classmethod
    def from_settings(
        cls,
        settings: TransformerSettings,
        embed_dim: int,
        *,
        causal: bool = False,
        positions: TemporalPositions = "none",
        num_frames: int = 1,
    ) -> TransformerBlock:
        """Builds a block of an inner or outer transformer.

        Args:
            settings: heads, FFN and dropout.
            embed_dim: width D of a token.
            causal: whether a position sees only itself and earlier ones.
            positions: whether attention sees distances: see :class:`SelfAttention`.
            num_frames: number K of positions of the longest sequence, if it does.
        """
        return cls(
            embed_dim,
            settings.num_heads,
            ffn_expansion=settings.ffn_expansion,
            activation=settings.activation,
            attention_dropout=settings.attention_dropout,
            ffn_dropout=settings.ffn_dropout,
            causal=causal,
            positions=positions,
            num_frames=num_frames,
        )

    def forward(self, x: Tensor, read: Read = "all") -> Tensor:
        """Transforms a sequence.

        Args:
            x: tokens, float [N, S, D].
            read: which positions to compute and return: all, the first or the last.

        Returns:
            float [N, S or 1, D].
        """
        x = x[:, READ_SLICES[read]] + self.attention(self.norm1(x), read)
        return x + self.ffn(self.norm2(x))

    def read_first(self, first: Tensor, rest: Tensor) -> Tensor:
        """Reads the first token, which must be the same in all sequences.

        This holds before the first block. The result is that of
        ``forward(torch.cat([first.expand(N, 1, D), rest], dim=1), "first")``.

        Args:
            first: float [1, 1, D].
            rest: tokens after it, float [N, S - 1, D].

        Returns:
            float [N, 1, D].
        """
        x = first + self.attention.read_first(self.norm1(first), self.norm1(rest))
        return x + self.ffn(self.norm2(x))

    def read_windows(self, x: Tensor, windows: Windows) -> Tensor:
        """Reads the newest token of windows on a table; tokens are projected once.

        Args:
            x: tokens of the table, float [R, D].
            windows: windows of sequences, [N, T, K].

        Returns:
            float [N, T, D]: that of ``forward(windows.gather(x), "last")``.
        """
        newest = Windows(windows.rows[..., -1], None).gather(x)
        x = newest + attend_windows(self.attention, self.norm1(x), windows)
        return x + self.ffn(self.norm2(x))

    def attention_weights(self, x: Tensor) -> Tensor:
        """Returns the attention weights of this block, float [N, heads, S, S]."""
        return self.attention.weights(self.norm1(x))
