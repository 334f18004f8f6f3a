"""Settings of frame encoders, which turn one observation into tokens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torchrl_tit.settings.checks import check_at_least, check_choice, check_probability
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

    embed_dim: int = 32
    """Width D of the token."""
    bias: bool = False
    """Whether the layer has a bias."""
    activation: Literal["none", "gelu", "gelu_tanh", "relu", "silu", "tanh"] = "none"
    """Activation after the layer."""

    def __post_init__(self) -> None:
        check_at_least(self, embed_dim=1)


@dataclass(frozen=True, kw_only=True)
class TransformerSettings:
    """Settings that inner and outer blocks share."""

    num_heads: int = 1
    """Attention heads of a block; must divide the width."""
    ffn_expansion: int = 4
    """Hidden width of a block's FFN as a multiple of the width."""
    activation: Activation = "gelu"
    """Activation in a block's FFN."""
    attention_dropout: float = 0.0
    """Dropout on the attention weights."""
    ffn_dropout: float = 0.0
    """Dropout on the FFN outputs."""
    share_blocks: bool = False
    """Whether all blocks share their weights."""

    def __post_init__(self) -> None:
        check_at_least(self, num_heads=1, ffn_expansion=1)
        check_probability(self, "attention_dropout", "ffn_dropout")


@dataclass(frozen=True, kw_only=True)
class PatchTransformerSettings(TransformerSettings):
    """Settings of a transformer on the patches of observations."""

    patch_size: int | Literal["auto"] | None = 1
    """Entries of an array's patch, or pixels along a side of an image's; the whole observation
    (of an image, which must be square) if not given. "auto" takes an array as one patch, makes at
    most 16 patches of categories, and about 49 of an image."""
    embed_dim: int = 32
    """Width D of a token."""
    patch_weights: Literal["shared", "own"] = "shared"
    """Whether all patches of an array share the weights of their embedding, which has no bias, or
    each has weights and a bias of its own, of one size (the feature tokenizer of arXiv 2106.11959).
    A shared patch of one entry reaches the attention as little more than the entry's sign."""
    num_blocks: int = 2
    """Number of blocks."""
    position_encoding: bool = True
    """Whether patches and class token get a learned position encoding."""
    every_block: bool = True
    """Whether to output the class token of every block, or of the last one only."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(self, embed_dim=1, num_blocks=1)
        if isinstance(self.patch_size, str):
            check_choice(self, "patch_size", ("auto",))
        elif self.patch_size is not None:
            check_at_least(self, patch_size=1)


@dataclass(frozen=True, kw_only=True)
class Inner(
    PatchTransformerSettings,
    FrameSettings,
    name="inner",
    builds="torchrl_tit.frames.inner:InnerTransformer",
):
    """The inner transformer of TIT (arXiv 2212.14538): class tokens after its blocks."""


@dataclass(frozen=True, kw_only=True)
class ResNetFrames(FrameSettings, name="resnet", builds="torchrl_tit.frames.cnn:CNNFrameEncoder"):
    """One token of an image: the residual network of the baselines and a linear layer."""

    embed_dim: int = 256
    """Width D of the token."""

    def __post_init__(self) -> None:
        check_at_least(self, embed_dim=1)


@dataclass(frozen=True, kw_only=True)
class NatureCNNFrames(
    FrameSettings, name="nature-cnn", builds="torchrl_tit.frames.cnn:CNNFrameEncoder"
):
    """One token of an image: the convolutions of NatureCNN and a linear layer."""

    embed_dim: int = 256
    """Width D of the token."""

    def __post_init__(self) -> None:
        check_at_least(self, embed_dim=1)
