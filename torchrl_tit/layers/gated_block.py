"""The gated block of GTrXL: gates take the place of residual connections."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_tit.layers.attention import READ_SLICES, Read
from torchrl_tit.layers.relative_attention import RelativeSelfAttention
from torchrl_tit.layers.window_attention import attend_windows
from torchrl_tit.settings.arguments import checked_arguments
from torchrl_tit.settings.numbers import Count, Frames, Real, Width
from torchrl_tit.windows import Windows


class GRUGate(nn.Module):
    r"""Mixes a stream x with an update y as a gated recurrent unit does.

    .. math::

        r = \sigma(W_r y + U_r x), \quad z = \sigma(W_z y + U_z x - b), \quad
        h = \tanh(W_h y + U_h (r \odot x)), \quad g = (1 - z) \odot x + z \odot h

    arXiv 1910.06764, section 3.2. With a bias b > 0 the gate starts near the identity x.

    Args:
        embed_dim: width D of x and y.
        bias: initial value of every entry of b, which is learned.

    Example:
        >>> gate, x = GRUGate(32, bias=100.0), torch.randn(8, 5, 32)
        >>> torch.equal(gate(x, torch.randn(8, 5, 32)), x)
        True
    """

    @checked_arguments
    def __init__(self, embed_dim: Width, bias: Real = 0.0) -> None:
        super().__init__()
        self.reset_y = nn.Linear(embed_dim, embed_dim, bias=False)
        self.reset_x = nn.Linear(embed_dim, embed_dim, bias=False)
        self.update_y = nn.Linear(embed_dim, embed_dim, bias=False)
        self.update_x = nn.Linear(embed_dim, embed_dim, bias=False)
        self.candidate_y = nn.Linear(embed_dim, embed_dim, bias=False)
        self.candidate_x = nn.Linear(embed_dim, embed_dim, bias=False)
        # Not a linear layer's bias, because initialisations set those to zero.
        self.bias = nn.Parameter(torch.empty(embed_dim))
        self.initial_bias = float(bias)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initialises the bias. The linear layers initialise themselves."""
        nn.init.constant_(self.bias, self.initial_bias)

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        """Stream x and update y, float [..., D] each -> float [..., D]."""
        reset = torch.sigmoid(self.reset_y(y) + self.reset_x(x))
        update = torch.sigmoid(self.update_y(y) + self.update_x(x) - self.bias)
        candidate = torch.tanh(self.candidate_y(y) + self.candidate_x(reset * x))
        return (1 - update) * x + update * candidate


class GatedTransformerBlock(nn.Module):
    """Block of GTrXL: ``gate(x, relu(attention(LN(x))))``, then ``gate(x, relu(FFN(LN(x))))``.

    arXiv 1910.06764, section 3.2, with the relative attention of Transformer-XL.

    Args:
        embed_dim: width D of a token.
        num_heads: attention heads; must divide ``embed_dim``.
        num_frames: number K of tokens, one for each frame.
        ffn_expansion: hidden width of the FFN as a multiple of ``embed_dim``.
        gate_bias: initial value of the gates' bias; 2 starts near the identity.

    Example:
        >>> block = GatedTransformerBlock(32, num_heads=4, num_frames=5)
        >>> block(torch.randn(8, 5, 32), causal=True).shape
        torch.Size([8, 5, 32])
    """

    @checked_arguments
    def __init__(
        self,
        embed_dim: Width,
        num_heads: Count,
        num_frames: Frames,
        *,
        ffn_expansion: Count = 4,
        gate_bias: Real = 0.0,
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(embed_dim)
        self.attention = RelativeSelfAttention(embed_dim, num_heads, num_frames)
        self.gate1 = GRUGate(embed_dim, gate_bias)
        self.norm2 = nn.LayerNorm(embed_dim)
        self.ffn = nn.Sequential(
            nn.Linear(embed_dim, ffn_expansion * embed_dim),
            nn.ReLU(),
            nn.Linear(ffn_expansion * embed_dim, embed_dim),
        )
        self.gate2 = GRUGate(embed_dim, gate_bias)

    def forward(self, x: Tensor, *, causal: bool, read: Read = "all") -> Tensor:
        """Transforms tokens, float [N, K, D] -> float [N, K or 1, D].

        Args:
            x: tokens.
            causal: whether a step sees only itself and earlier ones.
            read: which steps to compute and return: all, the first or the last.
        """
        mixed = self.attention(self.norm1(x), causal=causal, read=read)
        return self._gate(x[:, READ_SLICES[read]], mixed)

    def read_windows(self, x: Tensor, windows: Windows) -> Tensor:
        """Reads the newest token of windows on a table; tokens are projected once.

        Args:
            x: tokens of the table, float [R, D].
            windows: windows of sequences, [N, T, K].

        Returns:
            float [N, T, D]: that of ``forward(windows.gather(x), causal=True, read="last")``.
        """
        newest = Windows(windows.rows[..., -1], None).gather(x)
        return self._gate(newest, attend_windows(self.attention, self.norm1(x), windows))

    def _gate(self, x: Tensor, mixed: Tensor) -> Tensor:
        """The block's output from its input and the output of attention, float [..., D] each."""
        x = self.gate1(x, torch.relu(mixed))
        return self.gate2(x, torch.relu(self.ffn(self.norm2(x))))

    def attention_weights(self, x: Tensor) -> Tensor:
        """Returns the weights of causal attention, float [N, heads, K, K]."""
        return self.attention.weights(self.norm1(x), causal=True)
