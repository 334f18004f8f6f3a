"""Settings of encoders: frame encoders read one observation, history encoders the tokens of K.

None of them needs PyTorch: each names the module that it configures, which is imported when it is
built (:meth:`~torchrl_tit.settings.parts.Part.build`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from torchrl_tit.settings.numbers import Count, CountOrNone, Frames, Probability, Real, Steps, Width
from torchrl_tit.settings.parts import Part

__all__ = [
    "D2RL",
    "GRU",
    "LSTM",
    "MLP",
    "Activation",
    "Catformer",
    "ChainedOuter",
    "CoBERL",
    "DecisionTransformer",
    "Entities",
    "Flat",
    "FrameSettings",
    "GTrXL",
    "GatedDeltaNet",
    "HistorySettings",
    "Inner",
    "Linear",
    "LinearRecurrentSettings",
    "Mamba2",
    "MatrixMemorySettings",
    "MinGRU",
    "NatureCNNFrames",
    "OFENet",
    "Outer",
    "PairedOuter",
    "ResNetFrames",
    "StackedCNN",
    "StackedInner",
    "TemporalPositions",
]

Activation = Literal["gelu", "gelu_tanh", "relu", "silu", "tanh"]
"""Activation functions: see :func:`~torchrl_tit.layers.activations.make_activation`."""

TemporalPositions = Literal["none", "learned", "relative", "rotary"]
"""How attention tells the K frames apart: not at all, by a learned encoding that is added to the
tokens, by a learned bias for each distance and head, or by rotated queries and keys."""


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

    def block(self) -> dict[str, Any]:
        """Returns the arguments of a :class:`~torchrl_tit.layers.TransformerBlock` by name."""
        names = ("num_heads", "ffn_expansion", "activation", "attention_dropout", "ffn_dropout")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True, kw_only=True)
class ClassTokenSettings(TransformerSettings):
    """Settings of a transformer on the parts of an observation, which outputs class tokens."""

    embed_dim: Width = 32
    """Width D of a token."""
    num_blocks: Count = 2
    """Number of blocks."""
    every_block: bool = True
    """Whether to output the class token of every block, or of the last one only."""


@dataclass(frozen=True, kw_only=True)
class PatchTransformerSettings(ClassTokenSettings):
    """Settings of a transformer on the patches of observations."""

    patch_size: Width | Literal["auto"] | None = 1
    """Entries per patch of an array, or pixels per side of an image patch. If not given, the patch
    is the whole observation (images must then be square). "auto" uses one patch for an array, at
    most 16 patches for categories, and about 49 for an image."""
    patch_weights: Literal["shared", "own"] = "shared"
    """Whether all patches of an array share one embedding, which has no bias, or each patch has its
    own weights and bias, all of the same size (the feature tokenizer of arXiv 2106.11959). With
    shared weights and patches of one entry, attention sees little more than each entry's sign.
    Images and categories have embeddings of their own, whatever this says."""
    position_encoding: bool = True
    """Whether patches and class token get a learned position encoding."""


@dataclass(frozen=True, kw_only=True)
class Inner(
    PatchTransformerSettings,
    FrameSettings,
    name="inner",
    builds="torchrl_tit.frames.inner:InnerTransformer",
):
    """The inner transformer of TIT (arXiv 2212.14538), which outputs its class tokens."""


@dataclass(frozen=True, kw_only=True)
class Entities(
    ClassTokenSettings,
    FrameSettings,
    name="entities",
    builds="torchrl_tit.frames.entities:EntityTransformer",
):
    """An inner transformer on a set of entities: rows whose last entry says which are padding."""


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


@dataclass(frozen=True, kw_only=True)
class HistorySettings(Part, kind="history encoder"):
    """Settings of a history encoder: tokens [..., K, L, D] -> outputs [..., E]."""

    reads_actions: ClassVar[bool] = False
    """Whether it reads past actions and returns to go in addition to the tokens."""
    is_recurrent: ClassVar[bool] = False
    """Whether it carries a state from step to step when it reads one frame."""
    needs_several_frames: ClassVar[bool] = False
    """Whether it makes no sense with one frame."""

    def check_num_frames(self, num_frames: int) -> None:
        """Raises ValueError if the encoder cannot read that many frames."""
        if self.needs_several_frames and num_frames < 2:
            raise ValueError(
                f"{self.name} is a transformer over time, but num_frames is {num_frames}: set it "
                "to 2 or more"
            )


@dataclass(frozen=True, kw_only=True)
class OuterSettings(TransformerSettings, HistorySettings):
    """Settings that all outer transformers share."""

    temporal_positions: TemporalPositions = "none"
    """How the K frames are told apart (the paper's are not): by a learned encoding, a learned bias
    for each distance ("relative"), or rotations (RoPE)."""

    def check_num_frames(self, num_frames: int) -> None:
        """Raises ValueError if there are temporal positions but only one frame."""
        if self.temporal_positions != "none" and num_frames == 1:
            raise ValueError(
                f"temporal_positions {self.temporal_positions!r} tells frames apart, but "
                "num_frames is 1: raise it, or set temporal_positions to none"
            )

    @classmethod
    def from_older(cls, fields: dict[str, Any]) -> dict[str, Any]:
        """Converts the boolean field of older versions, which had learned positions only."""
        learned = fields.pop("temporal_position_encoding", None)
        if isinstance(learned, bool):
            fields["temporal_positions"] = "learned" if learned else "none"
        elif learned is not None:
            raise ValueError(f"temporal_position_encoding is true or false, not {learned!r}")
        return fields


@dataclass(frozen=True, kw_only=True)
class SlidingOuterSettings(OuterSettings):
    """Settings of outer blocks that read each other, and so can see beyond what one attends to."""

    attention_frames: Frames | None = None
    """Frames that a block attends to; by default all K. With A frames, N blocks see N (A - 1) + 1,
    which K must be. What a block says of a frame then depends on that frame and the A - 1 before
    it, wherever the history begins, so sequences compute it once. Positions are "none" or
    "rotary"."""


@dataclass(frozen=True, kw_only=True)
class Outer(
    SlidingOuterSettings, name="outer", builds="torchrl_tit.histories.outer:StackedOuterTransformer"
):
    """The outer transformer of Vanilla_TIT: stacked causal blocks over one token per frame."""

    num_blocks: Count = 2
    """Number of blocks."""
    dense: bool = False
    """Whether to output the concatenated outputs of all blocks, or only that of the last."""


@dataclass(frozen=True, kw_only=True)
class PairedOuter(
    OuterSettings, name="paired-outer", builds="torchrl_tit.histories.outer:PairedOuterTransformer"
):
    """The outer blocks of Enhanced_TIT: one for each token of a frame, all outputs concatenated."""


@dataclass(frozen=True, kw_only=True)
class ChainedOuter(
    SlidingOuterSettings,
    name="chained-outer",
    builds="torchrl_tit.histories.outer:ChainedOuterTransformer",
):
    """The outer blocks of Enhanced_TIT, each also reading the block before it, as in PDiT."""


@dataclass(frozen=True, kw_only=True)
class StackedInner(
    PatchTransformerSettings,
    HistorySettings,
    name="stacked-inner",
    builds="torchrl_tit.histories.stacked:StackedInnerTransformer",
):
    """Inner blocks on K frames that are stacked as channels: the paper's ablation "w/o Outer"."""


@dataclass(frozen=True, kw_only=True)
class StackedCNN(
    HistorySettings, name="stacked-cnn", builds="torchrl_tit.histories.stacked:StackedCNN"
):
    """A convolutional network on K images that are stacked as channels."""

    torso: Literal["nature-cnn", "resnet", "minatar-cnn"] = "nature-cnn"
    """The convolutions: those of the deep Q-network, the residual network of the baselines, or the
    one of MinAtar's baselines, for images of 10 x 10."""


@dataclass(frozen=True, kw_only=True)
class LayersSettings:
    """Settings of fully connected layers, by default those of Stable-Baselines3 for arrays."""

    hidden_dim: Width = 64
    """Width of every layer."""
    num_layers: Count = 2
    """Number of layers."""
    activation: Activation = "tanh"
    """Activation of every layer."""


@dataclass(frozen=True, kw_only=True)
class MLP(LayersSettings, HistorySettings, name="mlp", builds="torchrl_tit.histories.mlp:MLP"):
    """Fully connected layers on all entries of all tokens."""


@dataclass(frozen=True, kw_only=True)
class OFENet(
    LayersSettings, HistorySettings, name="ofenet", builds="torchrl_tit.histories.mlp:OFENet"
):
    """Fully connected layers that each read the input and the outputs of all previous layers."""


@dataclass(frozen=True, kw_only=True)
class D2RL(LayersSettings, HistorySettings, name="d2rl", builds="torchrl_tit.histories.mlp:D2RL"):
    """Fully connected layers that each read the input and the output of the previous layer."""


@dataclass(frozen=True, kw_only=True)
class Catformer(
    HistorySettings, name="catformer", builds="torchrl_tit.histories.catformer:Catformer"
):
    """Catformer: a transformer that concatenates its layers, by default as in arXiv 2212.14538."""

    num_blocks: Count = 2
    """Number of pairs of an attention layer and an FFN layer."""
    num_heads: Count = 5
    """Attention heads; must divide ``attention_expansion`` x the width."""
    attention_expansion: Count = 1
    """Width inside attention, as a multiple of the width (2 in its paper's tuning)."""
    ffn_expansion: Count = 4
    """Hidden width of an FFN as a multiple of the width."""
    temporal_positions: TemporalPositions = "learned"
    """How the K frames are told apart: by a learned encoding, a learned bias for each distance
    ("relative"), rotations (RoPE), or not at all."""

    needs_several_frames = True


@dataclass(frozen=True, kw_only=True)
class GatedTransformerSettings(HistorySettings):
    """Settings of gated transformer blocks, with GTrXL's widths (arXiv 1910.06764)."""

    num_blocks: Count = 2
    """Number of gated transformer blocks."""
    num_heads: Count = 8
    """Attention heads; must divide the width."""
    ffn_expansion: Count = 4
    """Hidden width of an FFN as a multiple of the width."""
    gate_bias: Real = 0.0
    """Initial bias of all gates; 2 starts them near the identity, as in GTrXL's paper."""

    needs_several_frames = True


@dataclass(frozen=True, kw_only=True)
class GTrXL(GatedTransformerSettings, name="gtrxl", builds="torchrl_tit.histories.gtrxl:GTrXL"):
    """GTrXL: a transformer whose residuals are gated. Its paper has 12 blocks."""

    gate_bias: Real = 2.0
    """Initial bias of all gates: 2, as in the paper, starts them near the identity."""


@dataclass(frozen=True, kw_only=True)
class CoBERL(GatedTransformerSettings, name="coberl", builds="torchrl_tit.histories.coberl:CoBERL"):
    """CoBERL: a gated transformer, a gate and an LSTM."""

    hidden_dim: Width = 512
    """Size of the LSTM's state, which is the encoder's output."""


@dataclass(frozen=True, kw_only=True)
class RecurrentSettings(HistorySettings):
    """Settings of recurrent networks.

    If they read one frame, they carry their state through the episode; otherwise it starts at 0.
    """

    is_recurrent = True

    hidden_dim: Width = 64
    """Size of the state, which is the encoder's output."""


@dataclass(frozen=True, kw_only=True)
class LSTM(RecurrentSettings, name="lstm", builds="torchrl_tit.histories.recurrent:LSTM"):
    """An LSTM. It carries its state through the episode if it reads one frame, else starts at 0."""


@dataclass(frozen=True, kw_only=True)
class GRU(RecurrentSettings, name="gru", builds="torchrl_tit.histories.recurrent:GRU"):
    """A GRU. It carries its state through the episode if it reads one frame, else starts at 0."""


@dataclass(frozen=True, kw_only=True)
class LinearRecurrentSettings(HistorySettings):
    """Settings of recurrent blocks that read whole sequences at once.

    If they read one frame, they carry their state through the episode; otherwise it starts at 0.
    """

    is_recurrent = True

    num_blocks: Count = 2
    """Number of blocks."""
    ffn_expansion: CountOrNone = 2
    """Hidden width of a block's gated FFN as a multiple of the width; 0 for blocks without one."""


@dataclass(frozen=True, kw_only=True)
class MinGRU(
    LinearRecurrentSettings, name="mingru", builds="torchrl_tit.histories.linear_recurrent:MinGRU"
):
    """minGRU (arXiv 2410.01201): a GRU whose gate does not read the state."""

    expansion: Count = 2
    """Size of a block's state as a multiple of the width."""


@dataclass(frozen=True, kw_only=True)
class MatrixMemorySettings(LinearRecurrentSettings):
    """Settings of recurrent blocks whose state is a matrix for each head."""

    num_heads: Count = 2
    """Heads of a block."""
    key_dim: Width = 16
    """Size of a head's keys and queries, by which its state is written and read."""
    value_dim: Width = 32
    """Size of a head's values. A state has num_heads x key_dim x value_dim entries in a block."""


@dataclass(frozen=True, kw_only=True)
class GatedDeltaNet(
    MatrixMemorySettings,
    name="gated-deltanet",
    builds="torchrl_tit.histories.linear_recurrent:GatedDeltaNet",
):
    """Gated DeltaNet (arXiv 2412.06464): it replaces the value that is stored under a key."""


@dataclass(frozen=True, kw_only=True)
class Mamba2(
    MatrixMemorySettings, name="mamba2", builds="torchrl_tit.histories.linear_recurrent:Mamba2"
):
    """Mamba-2 (arXiv 2405.21060): a state space whose decay depends on the step."""

    ffn_expansion: CountOrNone = 0
    """Hidden width of a block's gated FFN as a multiple of the width; 0, as in the paper, for
    blocks without one."""


@dataclass(frozen=True, kw_only=True)
class DecisionTransformer(
    HistorySettings,
    name="decision-transformer",
    builds="torchrl_tit.histories.decision_transformer:DecisionTransformer",
):
    """Decision Transformer, by default as in arXiv 2106.01345 for MuJoCo.

    It reads returns to go, actions and time steps in addition to the tokens of the frames.
    """

    reads_actions = True

    num_blocks: Count = 3
    """Number of GPT-2 blocks."""
    num_heads: Count = 1
    """Attention heads of a block; must divide the width."""
    ffn_dim: Width | None = None
    """Hidden width of a block's FFN; four times the width if not given."""
    activation: Activation = "relu"
    """Activation in a block's FFN."""
    dropout: Probability = 0.1
    """Dropout on the tokens, on attention weights, and on the outputs of attention and FFN."""
    max_ep_len: Steps = 1000
    """Number of time steps in the timestep embedding, counted from 0."""
    timestep_embedding: bool = True
    """Whether tokens get a learned embedding of their time step (Online DT has none)."""

    def check_num_frames(self, num_frames: int) -> None:
        """Raises ValueError if a window is longer than the longest episode."""
        if num_frames > self.max_ep_len:
            raise ValueError(
                f"num_frames {num_frames} is more than max_ep_len {self.max_ep_len}: lower it, or "
                "raise max_ep_len to the length of the longest episode"
            )
