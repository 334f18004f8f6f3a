"""Catformer: a transformer whose layers are concatenated instead of added."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_tit import settings
from torchrl_tit.histories.encoder import HistoryEncoder, HistoryShape, OneToken
from torchrl_tit.layers.attention import Read, SelfAttention


class CatformerAttention(nn.Module):
    """Attention layer: project the concatenation, LayerNorm, causal self-attention.

    Args:
        in_dim: width of the concatenation of all earlier layers' outputs.
        width: width D of the output.
        settings: heads, width inside attention, and temporal positions.
        num_frames: number K of frames.
        project: whether there is a projection; without one, ``in_dim`` is the attention's width.

    Raises:
        ValueError: if the heads do not divide the attention's width.
    """

    def __init__(
        self,
        in_dim: int,
        width: int,
        settings: settings.Catformer,
        *,
        num_frames: int,
        project: bool,
    ) -> None:
        super().__init__()
        attention_dim = settings.attention_expansion * width
        self.projection = nn.Linear(in_dim, attention_dim) if project else nn.Identity()
        self.norm = nn.LayerNorm(attention_dim)
        self.attention = SelfAttention(
            attention_dim,
            settings.num_heads,
            causal=True,
            out_dim=width,
            positions=settings.temporal_positions,
            num_frames=num_frames,
        )

    def forward(self, x: Tensor, read: Read = "all") -> Tensor:
        """Float [..., K, in_dim] -> float [..., K or 1, D]."""
        return self.attention(self.norm(self.projection(x)), read)


class Catformer(HistoryEncoder):
    """Catformer's layers over one token per frame, read at the newest frame.

    Davis et al., "Catformer: Designing Stable Transformers via Sensitivity Analysis", ICML 2021, as
    built for the baseline of arXiv 2212.14538. Attention and FFN layers alternate, without
    residuals: each layer after the first reads the concatenated outputs of all previous layers
    (without the tokens themselves). The weights have PyTorch's default initialization. If frames
    have several tokens, a linear layer merges them into one.

    Args:
        settings: blocks, heads, expansions and temporal positions.
        shape: shape of the input.

    Raises:
        ValueError: if the heads do not divide the attention's width.

    Example:
        >>> shape = HistoryShape(num_frames=4, num_tokens=1, width=32)
        >>> catformer = Catformer(settings.Catformer(num_heads=4), shape)
        >>> catformer(torch.randn(8, 4, 1, 32)).shape
        torch.Size([8, 32])
    """

    def __init__(self, settings: settings.Catformer, shape: HistoryShape) -> None:
        super().__init__(shape, out_features=shape.width)
        width = shape.width
        self.one_token = OneToken(shape)
        self.positions = (
            nn.Parameter(torch.empty(1, shape.num_frames, width))
            if settings.temporal_positions == "learned"
            else None
        )
        self.attentions = nn.ModuleList()
        self.ffns = nn.ModuleList()
        for index in range(settings.num_blocks):
            # The first layer reads the tokens without a projection, unless attention is wider.
            project = index > 0 or settings.attention_expansion > 1
            earlier = width * max(2 * index, 1)
            self.attentions.append(
                CatformerAttention(
                    earlier, width, settings, num_frames=shape.num_frames, project=project
                )
            )
            earlier = width * (2 * index + 1)
            self.ffns.append(
                nn.Sequential(
                    nn.LayerNorm(earlier),
                    nn.Linear(earlier, settings.ffn_expansion * width),
                    nn.GELU(),
                    nn.Linear(settings.ffn_expansion * width, width),
                )
            )
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initializes learned temporal positions: normal with a standard deviation of 0.02."""
        if self.positions is not None:
            nn.init.normal_(self.positions, std=0.02)

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens of K frames, float [..., K, L, D] -> float [..., D]."""
        x = self.one_token(tokens)  # [..., K, D]
        x = x if self.positions is None else x + self.positions[0]
        outputs: list[Tensor] = []  # of all layers so far, [..., K, D] each
        for index, (attention, ffn) in enumerate(zip(self.attentions, self.ffns, strict=True)):
            x = torch.cat(outputs, dim=-1) if outputs else x
            if index == len(self.ffns) - 1:  # the last two layers compute only the newest frame
                outputs = [output[..., -1:, :] for output in outputs]
                outputs.append(attention(x, read="last"))
            else:
                outputs.append(attention(x))
            outputs.append(ffn(torch.cat(outputs, dim=-1)))
        return outputs[-1].squeeze(-2)
