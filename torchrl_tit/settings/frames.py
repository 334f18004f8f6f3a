"""Settings of frame encoders, which turn one observation into tokens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torchrl_tit.settings.numbers import Count, Probability, Width
from torchrl_tit.settings.parts import Part

Activation = Literal["gelu", "gelu_tanh", "relu", "silu", "tanh"]


@dataclass(frozen=True, kw_only=True)
class FrameSettings(Part, kind="frame encoder"):
    """Settings of a frame encoder: [..., *observation_shape] -> tokens [..., L, D]."""


@dataclass(frozen=True, kw_only=True)
class Flat(FrameSettings, name="flat", builds="torchrl_tit.frames.flat:Flat"):
    """The raw observation as a single token, for encoders that stack frames."""


@dataclass(frozen=True, kw_only=True)
class Linear(FrameSettings, name="linear", builds="torchrl_tit.frames.linear:LinearFrameEncoder"):
    """One token: a linear layer on all entries of the observation."""

    embed_dim: Width = 32
    """Width D of the token."""
    bias: bool = False
    """Whether the layer has a bias."""
    activation: Literal["none", "gelu", "gelu_tanh", "relu", "silu", "tanh"] = "none"
    """Activation after the layer."""


@dataclass(frozen=True, kw_only=True)
class TransformerSettings:
    """Settings that inner and outer blocks share."""

    num_heads: Count = 1
    """Attention heads of a block; must divide the width."""
    ffn_expansion: Count = 4
    """Hidden width of a block's FFN as a multiple of the width."""
    activation: Activation = "gelu"
    """Activation in a block's FFN."""
    attention_dropout: Probability = 0.0
    """Dropout on the attention weights."""
    ffn_dropout: Probability = 0.0
    """Dropout on the FFN outputs."""
    share_blocks: bool = False
    """Whether all blocks share their weights."""


@dataclass(frozen=True, kw_only=True)
class PatchTransformerSettings(TransformerSettings):
    """Settings of a transformer on the patches of observations."""

    patch_size: Width | Literal["auto"] | None = 1
    """Entries per patch of an array, or pixels per side of an image patch. If not given, the patch
    is the whole observation (images must then be square). "auto" uses one patch for an array, at
    most 16 patches for categories, and about 49 for an image."""
    embed_dim: Width = 32
    """Width D of a token."""
    patch_weights: Literal["shared", "own"] = "shared"
    """Whether all patches of an array share one embedding, which has no bias, or each patch has its
    own weights and bias, all of the same size (the feature tokenizer of arXiv 2106.11959). With
    shared weights and patches of one entry, attention sees little more than each entry's sign."""
    num_blocks: Count = 2
    """Number of blocks."""
    position_encoding: bool = True
    """Whether patches and class token get a learned position encoding."""
    every_block: bool = True
    """Whether to output the class token of every block, or of the last one only."""


@dataclass(frozen=True, kw_only=True)
class Inner(
    PatchTransformerSettings,
    FrameSettings,
    name="inner",
    builds="torchrl_tit.frames.inner:InnerTransformer",
):
    """The inner transformer of TIT (arXiv 2212.14538), which outputs its class tokens."""


@dataclass(frozen=True, kw_only=True)
class ResNetFrames(FrameSettings, name="resnet", builds="torchrl_tit.frames.cnn:CNNFrameEncoder"):
    """One token per image: the baselines' residual network followed by a linear layer."""

    embed_dim: Width = 256
    """Width D of the token."""


@dataclass(frozen=True, kw_only=True)
class NatureCNNFrames(
    FrameSettings, name="nature-cnn", builds="torchrl_tit.frames.cnn:CNNFrameEncoder"
):
    """One token per image: NatureCNN's convolutions followed by a linear layer."""

    embed_dim: Width = 256
    """Width D of the token."""
