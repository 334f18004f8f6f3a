"""The transformer block of GPT-2."""

from __future__ import annotations

from torch import Tensor, nn

from torchrl_tit.layers.activations import make_activation
from torchrl_tit.layers.attention import SelfAttention
from torchrl_tit.layers.dropout import Dropout
from torchrl_tit.settings import Activation
from torchrl_tit.settings.arguments import checked_arguments
from torchrl_tit.settings.numbers import Count, Probability, Width


class GPT2Block(nn.Module):
    """Pre-LayerNorm block with dropout on both residuals, with the caller's mask.

    Radford et al., "Language Models are Unsupervised Multitask Learners" (2019). As there, the
    initial weights are normal with a standard deviation of 0.02, and the biases are zero.

    Args:
        embed_dim: width D of a token.
        num_heads: attention heads; must divide ``embed_dim``.
        ffn_dim: hidden width of the FFN.
        activation: activation of the FFN by name.
        dropout: on the attention weights and on the outputs of attention and FFN.

    Example:
        >>> import torch
        >>> block = GPT2Block(32, num_heads=4, ffn_dim=128)
        >>> causal = torch.ones(6, 6, dtype=torch.bool).tril()
        >>> block(torch.randn(8, 6, 32), causal, read=slice(1, None, 3)).shape
        torch.Size([8, 2, 32])
    """

    @checked_arguments
    def __init__(
        self,
        embed_dim: Width,
        num_heads: Count,
        ffn_dim: Width,
        *,
        activation: Activation = "gelu_tanh",
        dropout: Probability = 0.0,
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(embed_dim)
        self.attention = SelfAttention(embed_dim, num_heads, dropout=dropout)
        self.dropout = Dropout(dropout)
        self.norm2 = nn.LayerNorm(embed_dim)
        self.ffn = nn.Sequential(
            nn.Linear(embed_dim, ffn_dim),
            make_activation(activation),
            nn.Linear(ffn_dim, embed_dim),
            Dropout(dropout),
        )
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initialises as GPT-2 does."""
        for name, parameter in self.named_parameters():
            if name.endswith("bias"):
                nn.init.zeros_(parameter)
            elif parameter.ndim == 2:  # the norms' weights stay 1
                nn.init.normal_(parameter, std=0.02)

    def forward(self, x: Tensor, mask: Tensor, read: slice | None = None) -> Tensor:
        """Transforms a sequence.

        Args:
            x: tokens, float [N, S, D].
            mask: bool [S, S] or [N, 1, S, S], True where a position (row) sees another (column);
                each must see at least one.
            read: which positions to compute and return; by default all.

        Returns:
            float [N, positions read, D].
        """
        read = read or slice(None)
        x = x[:, read] + self.dropout(self.attention(self.norm1(x), read, mask))
        return x + self.ffn(self.norm2(x))

    def attention_weights(self, x: Tensor, mask: Tensor) -> Tensor:
        """Returns the attention weights of this block, float [N, heads, S, S]; see ``forward``."""
        return self.attention.weights(self.norm1(x), mask)
