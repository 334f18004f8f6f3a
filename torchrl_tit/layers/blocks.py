"""Transformer blocks: TIT's, GPT-2's and GTrXL's."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_tit.layers.activations import make_activation
from torchrl_tit.layers.attention import READ_SLICES, Read, RelativeSelfAttention, SelfAttention
from torchrl_tit.layers.window_attention import attend_windows
from torchrl_tit.settings.encoders import Activation, TemporalPositions
from torchrl_tit.windows import Windows, take


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
        >>> block = TransformerBlock(embed_dim=32, num_heads=4, ffn_expansion=4)
        >>> block(torch.randn(8, 5, 32), read="first").shape
        torch.Size([8, 1, 32])
    """

    def __init__(
        self,
        embed_dim: int,
        num_heads: int,
        *,
        ffn_expansion: int = 4,
        activation: Activation = "gelu",
        attention_dropout: float = 0.0,
        ffn_dropout: float = 0.0,
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
        self.ffn = _ffn(embed_dim, ffn_expansion * embed_dim, activation, ffn_dropout)

    def forward(self, x: Tensor, read: Read = "all", mask: Tensor | None = None) -> Tensor:
        """Transforms a sequence.

        Args:
            x: tokens, float [..., S, D].
            read: which positions to compute and return: all, the first or the last.
            mask: which positions see which others: see :meth:`SelfAttention.forward`.

        Returns:
            float [..., S or 1, D].
        """
        x = x[..., READ_SLICES[read], :] + self.attention(self.norm1(x), read, mask)
        return x + self.ffn(self.norm2(x))

    def read_windows(self, x: Tensor, windows: Windows) -> Tensor:
        """Reads the newest token of windows on a table; tokens are projected once.

        Args:
            x: tokens of the table, float [R, D].
            windows: windows of sequences, [N, T, K].

        Returns:
            float [N, T, D]: that of ``forward(windows.gather(x), "last")``.
        """
        x = _newest(x, windows) + attend_windows(self.attention, self.norm1(x), windows)
        return x + self.ffn(self.norm2(x))

    def read_every_row(self, x: Tensor, windows: Windows) -> Tensor:
        """Reads every row of a table.

        Args:
            x: tokens of the table, float [R, D].
            windows: the window of each row of the sequences, [N, span, A].

        Returns:
            float [R, D]; a row of no sequence, such as that of padding, sees itself alone.
        """
        inside = self.read_windows(x, windows).flatten(0, 1)
        alone = self(x[len(inside) :].unsqueeze(-2)).squeeze(-2)
        return torch.cat([inside, alone])


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
        >>> block = GPT2Block(32, num_heads=4, ffn_dim=128)
        >>> causal = torch.ones(6, 6, dtype=torch.bool).tril()
        >>> block(torch.randn(8, 6, 32), causal, read=slice(1, None, 3)).shape
        torch.Size([8, 2, 32])
    """

    def __init__(
        self,
        embed_dim: int,
        num_heads: int,
        ffn_dim: int,
        *,
        activation: Activation = "gelu_tanh",
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(embed_dim)
        self.attention = SelfAttention(embed_dim, num_heads, dropout=dropout)
        self.dropout = nn.Dropout(dropout)
        self.norm2 = nn.LayerNorm(embed_dim)
        self.ffn = _ffn(embed_dim, ffn_dim, activation, dropout)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initializes as GPT-2 does."""
        for name, parameter in self.named_parameters():
            if name.endswith("bias"):
                nn.init.zeros_(parameter)
            elif parameter.ndim == 2:  # the norms' weights stay 1
                nn.init.normal_(parameter, std=0.02)

    def forward(self, x: Tensor, mask: Tensor, read: slice = READ_SLICES["all"]) -> Tensor:
        """Transforms a sequence.

        Args:
            x: tokens, float [..., S, D].
            mask: bool [S, S] or [N, 1, S, S] (N is the product of the leading dimensions), True
                where a position (row) sees another (column); each must see at least one.
            read: which positions to compute and return.

        Returns:
            float [..., positions read, D].
        """
        x = x[..., read, :] + self.dropout(self.attention(self.norm1(x), read, mask))
        return x + self.ffn(self.norm2(x))


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

    def __init__(self, embed_dim: int, bias: float = 0.0) -> None:
        super().__init__()
        self.reset_y = nn.Linear(embed_dim, embed_dim, bias=False)
        self.reset_x = nn.Linear(embed_dim, embed_dim, bias=False)
        self.update_y = nn.Linear(embed_dim, embed_dim, bias=False)
        self.update_x = nn.Linear(embed_dim, embed_dim, bias=False)
        self.candidate_y = nn.Linear(embed_dim, embed_dim, bias=False)
        self.candidate_x = nn.Linear(embed_dim, embed_dim, bias=False)
        # Not a linear layer's bias, because initializations set those to zero.
        self.bias = nn.Parameter(torch.empty(embed_dim))
        self.initial_bias = float(bias)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initializes the bias. The linear layers initialize themselves."""
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

    def __init__(
        self,
        embed_dim: int,
        num_heads: int,
        num_frames: int,
        *,
        ffn_expansion: int = 4,
        gate_bias: float = 0.0,
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
        """Transforms tokens, float [..., K, D] -> float [..., K or 1, D].

        Args:
            x: tokens.
            causal: whether a step sees only itself and earlier ones.
            read: which steps to compute and return: all, the first or the last.
        """
        mixed = self.attention(self.norm1(x), causal=causal, read=read)
        return self._gate(x[..., READ_SLICES[read], :], mixed)

    def read_windows(self, x: Tensor, windows: Windows) -> Tensor:
        """Reads the newest token of windows on a table; tokens are projected once.

        Args:
            x: tokens of the table, float [R, D].
            windows: windows of sequences, [N, T, K].

        Returns:
            float [N, T, D]: that of ``forward(windows.gather(x), causal=True, read="last")``.
        """
        mixed = attend_windows(self.attention, self.norm1(x), windows)
        return self._gate(_newest(x, windows), mixed)

    def _gate(self, x: Tensor, mixed: Tensor) -> Tensor:
        """The block's output from its input and the output of attention, float [..., D] each."""
        x = self.gate1(x, torch.relu(mixed))
        return self.gate2(x, torch.relu(self.ffn(self.norm2(x))))


def _ffn(width: int, hidden: int, activation: Activation, dropout: float) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(width, hidden),
        make_activation(activation),
        nn.Linear(hidden, width),
        nn.Dropout(dropout),
    )


def _newest(x: Tensor, windows: Windows) -> Tensor:
    """The newest token of windows [N, T, K] on a table [R, D] -> [N, T, D]."""
    return take(x, windows.rows[..., -1])
