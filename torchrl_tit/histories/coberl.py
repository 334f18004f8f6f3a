"""CoBERL: gated transformer, gate and LSTM, with the predictions of its contrastive loss."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.modules import LSTM

from torchrl_tit import settings
from torchrl_tit.histories.encoder import HistoryShape
from torchrl_tit.histories.gtrxl import GatedTransformerEncoder
from torchrl_tit.layers.blocks import GRUGate


class CoBERL(GatedTransformerEncoder):
    """Gated transformer over one token per frame, a gate that mixes in its input, and an LSTM.

    Banino et al., "CoBERL: Contrastive BERT for Reinforcement Learning", arXiv 2107.05431, figure
    1; a baseline of arXiv 2212.14538. The gate lets the LSTM read the tokens themselves until the
    transformer's output is useful. The LSTM's state is zero at the start of each history. The
    weights have PyTorch's default initialization. If frames have several tokens, a linear layer
    merges them into one.

    Args:
        settings: blocks, heads, gates and the size of the LSTM's state.
        shape: shape of the input.

    Raises:
        ValueError: if the heads do not divide the width.

    Example:
        >>> shape = HistoryShape(num_frames=4, num_tokens=1, width=32)
        >>> coberl = CoBERL(settings.CoBERL(hidden_dim=64), shape)
        >>> coberl(torch.randn(8, 4, 1, 32)).shape
        torch.Size([8, 64])
    """

    def __init__(self, settings: settings.CoBERL, shape: HistoryShape) -> None:
        super().__init__(settings, shape, out_features=settings.hidden_dim)
        self.mask_token = nn.Parameter(torch.empty(shape.width))
        self.gate = GRUGate(shape.width, settings.gate_bias)
        # TorchRL's LSTM, which unlike PyTorch's works under vmap and in a compiled graph.
        self.lstm = LSTM(shape.width, settings.hidden_dim, batch_first=True)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initializes the mask token: normal with a standard deviation of 0.02."""
        nn.init.normal_(self.mask_token, std=0.02)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens of K frames, float [..., K, L, D] -> state of the LSTM, float [..., E]."""
        x = self.one_token(tokens)  # [..., K, D]
        x = self.gate(x, self._transform(x, causal=True))
        states, _ = self.lstm(x.reshape(-1, *x.shape[-2:]))  # [N, K, E]
        return states[:, -1].reshape(*x.shape[:-2], self.out_features)

    def predict_masked(self, tokens: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Predicts every frame's encoding from both sides, with the masked frames hidden.

        The contrastive loss compares the two at the masked frames (arXiv 2107.05431, section 2.1).
        The transformer sees past and future here; gate and LSTM are not used.

        Args:
            tokens: float [..., K, L, D].
            mask: bool [..., K], True where a frame is hidden (15% of them in the paper).

        Returns:
            The encodings of the frames and their predictions, float [..., K, D] each.
        """
        encodings = self.one_token(tokens)
        hidden = torch.where(mask.unsqueeze(-1), self.mask_token.to(encodings.dtype), encodings)
        return encodings, self._transform(hidden, causal=False)

    def _transform(self, x: Tensor, *, causal: bool) -> Tensor:
        """The gated blocks on [..., K, D]."""
        for block in self.blocks:
            x = block(x, causal=causal)
        return x
