"""History encoders: the tokens of K observations to one feature vector."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from torchrl_tit.networks.block import TransformerBlock


class OuterTransformer(nn.Module):
    """What both outer transformers share: L causal blocks over the steps, read at the last one.

    The paper gives the outer transformer no position encoding: the newest step then sees the past
    as a set. Temporal positions are an option that tells the steps apart.

    Args:
        history: number of steps K.
        embed_dim: width D of a token.
        num_blocks: number of blocks L.
        make_block: builds one causal block of that width.
        temporal_position_encoding: whether a learned position encoding of the K steps is added.
        share_blocks: whether all L blocks are one and the same.
        dense: whether the outputs of all blocks are concatenated, or only the last is put out.
    """

    def __init__(
        self,
        history: int,
        embed_dim: int,
        *,
        num_blocks: int,
        make_block: Callable[[], TransformerBlock],
        temporal_position_encoding: bool = False,
        share_blocks: bool = False,
        dense: bool = True,
    ) -> None:
        super().__init__()
        self.num_blocks = num_blocks
        self.dense = dense
        self.out_features = embed_dim * (num_blocks if dense else 1)
        self.positions = (
            nn.Parameter(torch.empty(history, 1, embed_dim)) if temporal_position_encoding else None
        )
        self.blocks = nn.ModuleList(make_block() for _ in range(1 if share_blocks else num_blocks))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Initialises temporal positions: normal with a standard deviation of 0.02."""
        if self.positions is not None:
            nn.init.normal_(self.positions, std=0.02)

    def _block(self, index: int) -> TransformerBlock:
        block = self.blocks[index % len(self.blocks)]
        assert isinstance(block, TransformerBlock)
        return block

    def _steps(self, tokens: Tensor) -> tuple[Tensor, tuple[int, ...]]:
        """[..., K, tokens, D] -> [N, K, tokens, D] with temporal positions, leading shape."""
        leading = tuple(tokens.shape[:-3])
        x = tokens.reshape(math.prod(leading), *tokens.shape[-3:])
        return x if self.positions is None else x + self.positions, leading


class PairedOuterTransformer(OuterTransformer):
    """The outer blocks of Enhanced_TIT (arXiv 2212.14538, section "Enhanced_TIT").

    Outer block l reads the class tokens that inner block l put out at the K steps, never the
    outer block before it. The last steps of all blocks are concatenated (the dense connection).
    Without the dense connection only the last pair matters: then there is one block and one token.

    Example:
        >>> def make_block():
        ...     return TransformerBlock(32, num_heads=4, causal=True)
        >>> outer = PairedOuterTransformer(4, 32, num_blocks=2, make_block=make_block)
        >>> outer(torch.randn(8, 4, 2, 32)).shape
        torch.Size([8, 64])
    """

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens of K steps, float [..., K, L, D] -> features, float [..., L * D]."""
        x, leading = self._steps(tokens)
        newest = [self._block(i)(x[:, :, i], read="last") for i in range(self.num_blocks)]
        return torch.cat(newest, dim=-1).reshape(*leading, self.out_features)

    def attention_maps(self, tokens: Tensor) -> list[Tensor]:
        """Returns the attention weights of each block, L x float [..., heads, K, K]."""
        x, leading = self._steps(tokens)
        maps = (self._block(i).attention_weights(x[:, :, i]) for i in range(self.num_blocks))
        return [weights.reshape(*leading, *weights.shape[1:]) for weights in maps]


class StackedOuterTransformer(OuterTransformer):
    """The outer transformer of Vanilla_TIT (arXiv 2212.14538, section "The Outer Transformer").

    L causal blocks, each on the one before, over one token a step; the last step of the last block
    is put out, or of all blocks where the dense connection is on (the ablation without inner
    blocks).

    Example:
        >>> def make_block():
        ...     return TransformerBlock(32, num_heads=4, causal=True)
        >>> outer = StackedOuterTransformer(4, 32, num_blocks=2, make_block=make_block, dense=False)
        >>> outer(torch.randn(8, 4, 1, 32)).shape
        torch.Size([8, 32])
    """

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens of K steps, float [..., K, 1, D] -> features, float [..., D or L * D]."""
        x, leading = self._steps(tokens)
        x = x[:, :, 0]
        newest = []
        for index in range(self.num_blocks):
            last = index == self.num_blocks - 1
            x = self._block(index)(x, read="last" if last else "all")
            if last or self.dense:
                newest.append(x[:, -1])
        return torch.cat(newest, dim=-1).reshape(*leading, self.out_features)

    def attention_maps(self, tokens: Tensor) -> list[Tensor]:
        """Returns the attention weights of each block, L x float [..., heads, K, K]."""
        x, leading = self._steps(tokens)
        x = x[:, :, 0]
        maps = []
        for index in range(self.num_blocks):
            weights = self._block(index).attention_weights(x)
            maps.append(weights.reshape(*leading, *weights.shape[1:]))
            x = self._block(index)(x)
        return maps
