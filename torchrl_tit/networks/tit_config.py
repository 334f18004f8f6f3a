"""Hyperparameters of Vanilla_TIT and Enhanced_TIT, and the parts that they describe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torchrl_tit.networks.activations import Activation
from torchrl_tit.networks.block import TransformerBlock
from torchrl_tit.networks.config import check_positive, check_probability
from torchrl_tit.networks.inner import InnerTransformer
from torchrl_tit.networks.outer import PairedOuterTransformer, StackedOuterTransformer


@dataclass(frozen=True, kw_only=True)
class TITConfig:
    """Hyperparameters of both networks (arXiv 2212.14538, appendix "Hyperparameters")."""

    patch_size: int = 1
    """Entries of an array's patch, or pixels along a side of an image's."""
    embed_dim: int = 32
    """Width of a token, the same in the inner and the outer transformer."""
    num_blocks: int = 2
    """Number L of inner blocks and of outer blocks."""
    num_heads_inner: int = 1
    """Attention heads of an inner block; must divide the width."""
    num_heads_outer: int = 1
    """Attention heads of an outer block; must divide the width."""
    ffn_expansion_inner: int = 4
    """Hidden width of an inner block's FFN as a multiple of the width."""
    ffn_expansion_outer: int = 4
    """Hidden width of an outer block's FFN as a multiple of the width."""
    activation_inner: Activation = "gelu"
    """Activation in an inner block's FFN."""
    activation_outer: Activation = "gelu"
    """Activation in an outer block's FFN."""
    attention_dropout_inner: float = 0.0
    """Dropout on the attention weights of inner blocks."""
    attention_dropout_outer: float = 0.0
    """Dropout on the attention weights of outer blocks."""
    ffn_dropout_inner: float = 0.0
    """Dropout on the FFN outputs of inner blocks."""
    ffn_dropout_outer: float = 0.0
    """Dropout on the FFN outputs of outer blocks."""
    position_encoding: bool = True
    """Whether patches and class token get a learned position encoding."""
    temporal_position_encoding: bool = False
    """Whether the K steps get a learned position encoding (not in the paper)."""
    share_blocks: bool = False
    """Whether all inner blocks are one block, and all outer blocks too."""
    features_dim: int = 64
    """Size of the features that the network puts out."""
    activation_head: Activation = "tanh"
    """Activation of the head: LayerNorm, linear, activation, LayerNorm."""

    def __post_init__(self) -> None:
        check_positive(
            self,
            "patch_size",
            "embed_dim",
            "num_blocks",
            "ffn_expansion_inner",
            "ffn_expansion_outer",
            "features_dim",
        )
        check_probability(
            self,
            "attention_dropout_inner",
            "attention_dropout_outer",
            "ffn_dropout_inner",
            "ffn_dropout_outer",
        )

    def make_inner_block(self) -> TransformerBlock:
        """Builds an inner block."""
        return TransformerBlock(
            self.embed_dim,
            self.num_heads_inner,
            ffn_expansion=self.ffn_expansion_inner,
            activation=self.activation_inner,
            attention_dropout=self.attention_dropout_inner,
            ffn_dropout=self.ffn_dropout_inner,
        )

    def make_outer_block(self) -> TransformerBlock:
        """Builds an outer block: causal over the steps."""
        return TransformerBlock(
            self.embed_dim,
            self.num_heads_outer,
            ffn_expansion=self.ffn_expansion_outer,
            activation=self.activation_outer,
            attention_dropout=self.attention_dropout_outer,
            ffn_dropout=self.ffn_dropout_outer,
            causal=True,
        )

    def make_inner(
        self, observation_shape: Sequence[int], *, every_block: bool, frames: int | None = None
    ) -> InnerTransformer:
        """Builds the inner transformer."""
        return InnerTransformer(
            observation_shape,
            self.patch_size,
            self.embed_dim,
            num_blocks=self.num_blocks,
            make_block=self.make_inner_block,
            every_block=every_block,
            position_encoding=self.position_encoding,
            share_blocks=self.share_blocks,
            frames=frames,
        )

    def make_stacked_outer(self, history: int, *, dense: bool) -> StackedOuterTransformer:
        """Builds the outer transformer whose blocks stand on each other."""
        return StackedOuterTransformer(
            history,
            self.embed_dim,
            num_blocks=self.num_blocks,
            make_block=self.make_outer_block,
            temporal_position_encoding=self.temporal_position_encoding,
            share_blocks=self.share_blocks,
            dense=dense,
        )


@dataclass(frozen=True, kw_only=True)
class VanillaTITConfig(TITConfig):
    """Hyperparameters of Vanilla_TIT: those of both networks and no others."""


@dataclass(frozen=True, kw_only=True)
class EnhancedTITConfig(TITConfig):
    """Hyperparameters of Enhanced_TIT: those of both networks and the paper's ablations."""

    dense: bool = True
    """Whether the outputs of all blocks are concatenated; off is the paper's "w/o Dense"."""
    inner: bool = True
    """Whether there are inner blocks; off is the paper's "w/o Inner": a linear embedding."""
    outer: bool = True
    """Whether there are outer blocks; off is "w/o Outer": frames stacked as channels."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (self.inner or self.outer):
            raise ValueError("inner and outer cannot both be off: nothing would be left")
        if self.temporal_position_encoding and not self.outer:
            raise ValueError(
                "temporal_position_encoding is that of the outer blocks: switch it off, or outer on"
            )

    def make_paired_outer(self, history: int) -> PairedOuterTransformer:
        """Builds the outer blocks that each stand beside an inner block."""
        # Without the dense connection only the last pair's output is read.
        return PairedOuterTransformer(
            history,
            self.embed_dim,
            num_blocks=self.num_blocks if self.dense else 1,
            make_block=self.make_outer_block,
            temporal_position_encoding=self.temporal_position_encoding,
            share_blocks=self.share_blocks,
            dense=self.dense,
        )
