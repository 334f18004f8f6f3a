"""GTrXL: a transformer over frames whose residuals are gated."""

from __future__ import annotations

from torch import Tensor, nn

from torchrl_tit import settings
from torchrl_tit.histories.encoder import HistoryEncoder, HistoryShape, OneToken
from torchrl_tit.layers.blocks import GatedTransformerBlock
from torchrl_tit.layers.window_attention import worth_a_table
from torchrl_tit.windows import Windows


class GatedTransformerEncoder(HistoryEncoder):
    """The base of GTrXL and CoBERL: gated blocks with relative positions, one token per frame.

    If frames have several tokens, a linear layer merges them into one.

    Args:
        settings: blocks, heads and gates.
        shape: shape of the input.
        out_features: size of the output.
    """

    def __init__(
        self, settings: settings.GTrXL | settings.CoBERL, shape: HistoryShape, *, out_features: int
    ) -> None:
        super().__init__(shape, out_features=out_features)
        self.one_token = OneToken(shape)
        self.blocks = nn.ModuleList(
            GatedTransformerBlock(
                shape.width,
                settings.num_heads,
                shape.num_frames,
                ffn_expansion=settings.ffn_expansion,
                gate_bias=settings.gate_bias,
            )
            for _ in range(settings.num_blocks)
        )


class GTrXL(GatedTransformerEncoder):
    """GTrXL's blocks over one token per frame, read at the newest frame.

        x = gate(x, relu(attention(LN(x))))    causal, relative positions of Transformer-XL
        x = gate(x, relu(FFN(LN(x))))          gates as in a GRU; their bias starts at 2

    Parisotto et al., "Stabilizing Transformers for Reinforcement Learning", arXiv 1910.06764,
    section 3. LayerNorm is on the branches only and the gates start near the identity, so a new
    network passes the newest frame through.

    The paper's blocks also attend to a memory: the outputs of earlier steps, computed with older
    weights and without gradients, so that the context grows with each block. Here a block sees only
    the K frames of the window, computed with the current weights and with gradients. The output
    depends on these K frames alone, as for every encoder.

    The last block computes only the newest frame, because only this is read. The weights have
    PyTorch's default initialization.

    Args:
        settings: blocks, heads and gates.
        shape: shape of the input.

    Raises:
        ValueError: if the heads do not divide the width.

    Example:
        >>> import torch
        >>> shape = HistoryShape(num_frames=4, num_tokens=1, width=32)
        >>> gtrxl = GTrXL(settings.GTrXL(), shape)
        >>> gtrxl(torch.randn(8, 4, 1, 32)).shape
        torch.Size([8, 32])
    """

    def __init__(self, settings: settings.GTrXL, shape: HistoryShape) -> None:
        super().__init__(settings, shape, out_features=shape.width)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens of K frames, float [..., K, L, D] -> float [..., D]."""
        x = self.one_token(tokens)  # [..., K, D]
        *earlier, last = self.blocks
        for block in earlier:
            x = block(x, causal=True)
        return last(x, causal=True, read="last").squeeze(-2)

    def reads_tables(self, windows: Windows) -> bool:
        """Whether the only block can project the tokens of a frame once for all windows.

        With several, what a block passes on at a frame depends on where the window begins.
        """
        return len(self.blocks) == 1 and worth_a_table(windows)

    def read_table(self, tokens: Tensor, windows: Windows) -> Tensor:
        """Tokens of a table of frames, float [R, L, D] -> float [N, T, D]."""
        block = self.blocks[0]
        assert isinstance(block, GatedTransformerBlock)
        return block.read_windows(self.one_token(tokens), windows)
