"""Settings of whole networks: which frame encoder, which history encoder, and what follows them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, ClassVar, Literal

from torchrl_tit.settings import encoders
from torchrl_tit.settings.checks import check_fields
from torchrl_tit.settings.encoders import (
    Activation,
    FrameSettings,
    HistorySettings,
    TemporalPositions,
)
from torchrl_tit.settings.numbers import Frames, Width


@dataclass(frozen=True, kw_only=True)
class Head:
    """The layers between the history encoder and the features."""

    features_dim: Width | None = 64
    """Size F of the features; if not given, the features are the history encoder's output."""
    activation: Activation = "tanh"
    """Activation after the linear layer."""
    norm: bool = True
    """Whether to add a LayerNorm before the linear layer and another one after the activation."""

    removed: ClassVar[dict[str, Any]] = {"final_norm": True}
    """Fields of older versions that no longer exist, with the values at which they did nothing."""

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True, kw_only=True)
class Network:
    """A frame encoder followed by a history encoder and a head, in any valid combination."""

    frame: FrameSettings
    """The frame encoder, which turns one observation into tokens. If a task has several
    observations, it encodes those that it can read and that ``frames`` does not name; the others
    get an encoder of the same width, chosen by their kind."""
    frames: Mapping[str, FrameSettings] = field(default_factory=dict, hash=False)
    """Frame encoders by the name of their observation, for tasks with several observations."""
    history: HistorySettings
    """The history encoder, which turns the tokens of the last K frames into one vector."""
    head: Head = field(default_factory=Head)
    """The head, which turns that vector into features."""
    num_frames: Frames = 1
    """Number K of observations that the network reads."""
    trunks: Literal["shared", "separate"] = "shared"
    """Whether PPO's policy and value share one network or have one each."""
    initialization: Literal["normal", "default"] = "default"
    """Initialization of the weights: normal with a standard deviation of 0.02, as in the authors'
    code, or the default of each layer."""

    def __post_init__(self) -> None:
        if not isinstance(self.frames, Mapping):
            raise ValueError(
                f"frames are settings by the name of an observation, not {self.frames!r}"
            )
        for name, frame in self.frames.items():
            if not isinstance(name, str) or not isinstance(frame, FrameSettings):
                raise ValueError(
                    f"frames[{name!r}] must be the settings of a frame encoder, such as "
                    f"torchrl_tit.settings.Inner(), not {frame!r}"
                )
        check_fields(self)
        self.history.check_num_frames(self.num_frames)

    @property
    def carries_state(self) -> bool:
        """Whether the network carries a state between steps instead of reading several frames."""
        return self.history.is_recurrent and self.num_frames == 1


def vanilla_tit(
    num_frames: int = 1,
    *,
    patch_size: int | Literal["auto"] | None = 1,
    patch_weights: Literal["shared", "own"] = "shared",
    embed_dim: int = 32,
    num_blocks: int = 2,
    num_heads_inner: int = 1,
    num_heads_outer: int = 1,
    ffn_expansion_inner: int = 4,
    ffn_expansion_outer: int = 4,
    activation_inner: Activation = "gelu",
    activation_outer: Activation = "gelu",
    attention_dropout_inner: float = 0.0,
    attention_dropout_outer: float = 0.0,
    ffn_dropout_inner: float = 0.0,
    ffn_dropout_outer: float = 0.0,
    position_encoding: bool = True,
    temporal_positions: TemporalPositions = "none",
    share_blocks: bool = False,
    features_dim: int = 64,
    activation_head: Activation = "tanh",
) -> Network:
    """Vanilla_TIT: the inner transformer's last class token, and the outer transformer on it.

    arXiv 2212.14538, section "Vanilla_TIT", figure 1.

    Args:
        num_frames: number K of observations.
        patch_size: entries per patch of an array, or pixels per side of an image patch; if None,
            the whole observation; "auto" chooses (see
            :func:`~torchrl_tit.layers.patches.find_patch_size`).
        patch_weights: whether all patches of an array share their weights, or each has its "own"
            weights and bias.
        embed_dim: width D of a token.
        num_blocks: number L of inner blocks and of outer blocks.
        num_heads_inner: attention heads of an inner block; must divide the width.
        num_heads_outer: attention heads of an outer block; must divide the width.
        ffn_expansion_inner: hidden width of an inner block's FFN as a multiple of the width.
        ffn_expansion_outer: hidden width of an outer block's FFN as a multiple of the width.
        activation_inner: activation in an inner block's FFN.
        activation_outer: activation in an outer block's FFN.
        attention_dropout_inner: dropout on the attention weights of inner blocks.
        attention_dropout_outer: dropout on the attention weights of outer blocks.
        ffn_dropout_inner: dropout on the FFN outputs of inner blocks.
        ffn_dropout_outer: dropout on the FFN outputs of outer blocks.
        position_encoding: whether patches and class token get a learned position encoding.
        temporal_positions: how the K frames are told apart (in the paper they are not): "learned"
            encodings, a learned bias for each distance ("relative"), or "rotary".
        share_blocks: whether all inner blocks share weights, and all outer blocks too.
        features_dim: size of the features.
        activation_head: activation of the head.
    """
    return Network(
        frame=encoders.Inner(
            patch_size=patch_size,
            patch_weights=patch_weights,
            embed_dim=embed_dim,
            num_blocks=num_blocks,
            num_heads=num_heads_inner,
            ffn_expansion=ffn_expansion_inner,
            activation=activation_inner,
            attention_dropout=attention_dropout_inner,
            ffn_dropout=ffn_dropout_inner,
            position_encoding=position_encoding,
            share_blocks=share_blocks,
            every_block=False,
        ),
        history=encoders.Outer(
            num_blocks=num_blocks,
            num_heads=num_heads_outer,
            ffn_expansion=ffn_expansion_outer,
            activation=activation_outer,
            attention_dropout=attention_dropout_outer,
            ffn_dropout=ffn_dropout_outer,
            temporal_positions=temporal_positions,
            share_blocks=share_blocks,
        ),
        head=Head(features_dim=features_dim, activation=activation_head),
        num_frames=num_frames,
        initialization="normal",
    )


def enhanced_tit(
    num_frames: int = 1,
    *,
    dense: bool = True,
    inner: bool = True,
    outer: bool = True,
    **hyperparameters: Any,
) -> Network:
    """Enhanced_TIT: an outer block beside every inner block, all outer outputs concatenated.

    arXiv 2212.14538, section "Enhanced_TIT", figure 2, and its ablations.

    Args:
        num_frames: number K of observations.
        dense: False is the paper's "w/o Dense": only the last outer block is read.
        inner: False is "w/o Inner": a linear embedding, then outer blocks in sequence.
        outer: False is "w/o Outer": frames stacked as channels, and inner blocks only.
        **hyperparameters: those of :func:`vanilla_tit`.

    Raises:
        ValueError: if ``inner`` and ``outer`` are both False, or a hyperparameter is invalid.

    Example:
        >>> enhanced_tit(4, inner=False).frame
        Linear(embed_dim=32, bias=False, activation='none')
    """
    if not (inner or outer):
        raise ValueError("inner and outer cannot both be off: nothing would be left")
    if hyperparameters.get("temporal_positions", "none") != "none" and not outer:
        raise ValueError(
            "temporal_positions are those of the outer blocks: set them to none, or outer to True"
        )
    vanilla = vanilla_tit(num_frames, **hyperparameters)
    assert isinstance(vanilla.frame, encoders.Inner)
    assert isinstance(vanilla.history, encoders.Outer)
    if not outer:
        stacked = encoders.StackedInner(**{**asdict(vanilla.frame), "every_block": dense})
        return replace(vanilla, frame=encoders.Flat(), history=stacked)
    if not inner:
        frame = encoders.Linear(embed_dim=vanilla.frame.embed_dim)
        return replace(vanilla, frame=frame, history=replace(vanilla.history, dense=dense))
    shared = asdict(vanilla.history)
    paired = encoders.PairedOuter(**{f.name: shared[f.name] for f in fields(encoders.PairedOuter)})
    return replace(vanilla, frame=replace(vanilla.frame, every_block=dense), history=paired)


def nature_cnn(num_frames: int = 1, *, features_dim: int = 512) -> Network:
    """NatureCNN: the frames stacked as channels, three convolutions, one linear layer with relu.

    Mnih et al., "Human-level control through deep reinforcement learning", Nature 518 (2015); the
    baseline "NatureCNN + MLP" of arXiv 2212.14538.
    """
    head = Head(features_dim=features_dim, activation="relu", norm=False)
    return Network(
        frame=encoders.Flat(), history=encoders.StackedCNN(), head=head, num_frames=num_frames
    )


def resnet(num_frames: int = 1, *, features_dim: int = 512) -> Network:
    """ResNet: the frames stacked as channels, a residual network, one linear layer with relu.

    The baseline "ResNet + MLP" of arXiv 2212.14538.
    """
    return replace(
        nature_cnn(num_frames, features_dim=features_dim),
        history=encoders.StackedCNN(torso="resnet"),
    )


def catformer(
    num_frames: int = 2, *, embed_dim: int = 255, features_dim: int = 512, **hyperparameters: Any
) -> Network:
    """Catformer: a residual network on each frame, then Catformer's layers over the frames.

    Davis et al., "Catformer: Designing Stable Transformers via Sensitivity Analysis", ICML 2021, as
    built for the baseline of arXiv 2212.14538.

    Args:
        num_frames: number K of observations.
        embed_dim: width of a token.
        features_dim: size of the features.
        **hyperparameters: fields of :class:`Catformer`.
    """
    return _on_images(num_frames, embed_dim, encoders.Catformer(**hyperparameters), features_dim)


def gtrxl(
    num_frames: int = 2, *, embed_dim: int = 256, features_dim: int = 512, **hyperparameters: Any
) -> Network:
    """GTrXL: a residual network on each frame, then a gated transformer over the frames.

    Parisotto et al., "Stabilizing Transformers for Reinforcement Learning", arXiv 1910.06764. It is
    not a baseline of arXiv 2212.14538; frame encoder and head are those of :func:`catformer`. For
    arrays, replace the frame encoder, for example with :class:`Linear`.

    Args:
        num_frames: number K of observations.
        embed_dim: width of a token.
        features_dim: size of the features.
        **hyperparameters: fields of :class:`GTrXL`.
    """
    return _on_images(num_frames, embed_dim, encoders.GTrXL(**hyperparameters), features_dim)


def coberl(
    num_frames: int = 2, *, embed_dim: int = 256, features_dim: int = 512, **hyperparameters: Any
) -> Network:
    """CoBERL: a residual network on each frame, a gated transformer over them, a gate and an LSTM.

    Banino et al., "CoBERL: Contrastive BERT for Reinforcement Learning", arXiv 2107.05431, figure
    1; a baseline of arXiv 2212.14538.

    Args:
        num_frames: number K of observations.
        embed_dim: width of a token.
        features_dim: size of the LSTM's state, which is the features.
        **hyperparameters: further fields of :class:`CoBERL`.
    """
    history = encoders.CoBERL(hidden_dim=features_dim, **hyperparameters)
    return _on_images(num_frames, embed_dim, history, features_dim=None)


def mlp(num_frames: int = 1, **hyperparameters: Any) -> Network:
    """MLP: two tanh layers of 64 on all entries of K arrays, separate for policy and value.

    The baseline of arXiv 2212.14538 for arrays.

    Args:
        num_frames: number K of observations.
        **hyperparameters: fields of :class:`MLP`.
    """
    return _separate(num_frames, encoders.MLP(**hyperparameters))


def ofenet(num_frames: int = 1, **hyperparameters: Any) -> Network:
    """OFENet: an MLP with dense connections, separate for policy and value.

    Ota et al., "Can Increasing Input Dimensionality Improve Deep Reinforcement Learning?", ICML
    2020, as built for the baseline of arXiv 2212.14538: without its auxiliary loss.

    Args:
        num_frames: number K of observations.
        **hyperparameters: fields of :class:`OFENet`.
    """
    return _separate(num_frames, encoders.OFENet(**hyperparameters))


def d2rl(num_frames: int = 1, **hyperparameters: Any) -> Network:
    """D2RL: an MLP whose layers all read the observation, separate for policy and value.

    Sinha et al., "D2RL: Deep Dense Architectures in Reinforcement Learning", arXiv 2010.09163, as
    built for the baseline of arXiv 2212.14538: the output includes the observation.

    Args:
        num_frames: number K of observations.
        **hyperparameters: fields of :class:`D2RL`.
    """
    return _separate(num_frames, encoders.D2RL(**hyperparameters))


def lstm(
    num_frames: int = 1, *, embed_dim: int = 64, hidden_dim: int = 64, features_dim: int = 64
) -> Network:
    """LSTM: a tanh layer on the observation, TorchRL's LSTM, and TIT's head.

    Small observations (positions, say) hardly change the state; the head's LayerNorm makes these
    changes readable.

    Args:
        num_frames: if 1, the state is carried through the episode; if more, it starts at 0.
        embed_dim: width of the tanh layer.
        hidden_dim: size of the state.
        features_dim: size of the features.
    """
    return Network(
        frame=encoders.Linear(embed_dim=embed_dim, bias=True, activation="tanh"),
        history=encoders.LSTM(hidden_dim=hidden_dim),
        head=Head(features_dim=features_dim),
        num_frames=num_frames,
    )


def gru(
    num_frames: int = 1, *, embed_dim: int = 64, hidden_dim: int = 64, features_dim: int = 64
) -> Network:
    """GRU: like :func:`lstm`, with TorchRL's GRU.

    Args:
        num_frames: if 1, the state is carried through the episode; if more, it starts at 0.
        embed_dim: width of the tanh layer.
        hidden_dim: size of the state.
        features_dim: size of the features.
    """
    return replace(
        lstm(num_frames, embed_dim=embed_dim, features_dim=features_dim),
        history=encoders.GRU(hidden_dim=hidden_dim),
    )


def mingru(num_frames: int = 1, *, embed_dim: int = 64, **hyperparameters: Any) -> Network:
    """MinGRU: like :func:`lstm`, with minGRU, which trains on whole sequences at once.

    Args:
        num_frames: if 1, the state is carried through the episode; if more, it starts at 0.
        embed_dim: width of a token and of the blocks.
        **hyperparameters: fields of :class:`MinGRU`.
    """
    return replace(
        lstm(num_frames, embed_dim=embed_dim), history=encoders.MinGRU(**hyperparameters)
    )


def gated_deltanet(num_frames: int = 1, *, embed_dim: int = 64, **hyperparameters: Any) -> Network:
    """Gated DeltaNet: like :func:`mingru`, with an associative memory as its state.

    Args:
        num_frames: if 1, the state is carried through the episode; if more, it starts at 0.
        embed_dim: width of a token and of the blocks.
        **hyperparameters: fields of :class:`GatedDeltaNet`.
    """
    return replace(
        lstm(num_frames, embed_dim=embed_dim), history=encoders.GatedDeltaNet(**hyperparameters)
    )


def mamba2(num_frames: int = 1, *, embed_dim: int = 64, **hyperparameters: Any) -> Network:
    """Mamba-2: like :func:`mingru`, with a state space as its state.

    Args:
        num_frames: if 1, the state is carried through the episode; if more, it starts at 0.
        embed_dim: width of a token and of the blocks.
        **hyperparameters: fields of :class:`Mamba2`.
    """
    return replace(
        lstm(num_frames, embed_dim=embed_dim), history=encoders.Mamba2(**hyperparameters)
    )


def decision_transformer(
    num_frames: int = 20, *, embed_dim: int = 128, **hyperparameters: Any
) -> Network:
    """Decision Transformer: returns to go, states and actions of K steps, states embedded linearly.

    Chen et al., "Decision Transformer: Reinforcement Learning via Sequence Modeling", arXiv
    2106.01345, section 3.

    Args:
        num_frames: steps K of a window.
        embed_dim: width of a token.
        **hyperparameters: fields of :class:`DecisionTransformer`.
    """
    return Network(
        frame=encoders.Linear(embed_dim=embed_dim, bias=True),
        history=encoders.DecisionTransformer(**hyperparameters),
        head=Head(features_dim=None),
        num_frames=num_frames,
    )


def dt_tit(
    num_frames: int = 20,
    *,
    embed_dim: int = 128,
    patch_size: int | Literal["auto"] | None = None,
    num_blocks_inner: int = 1,
    num_heads_inner: int = 1,
    ffn_expansion_inner: int = 1,
    activation_inner: Activation = "relu",
    position_encoding: bool = False,
    **hyperparameters: Any,
) -> Network:
    """DT_TIT: a Decision Transformer whose states are read by an inner transformer.

    arXiv 2212.14538, section on offline supervised learning.

    Args:
        num_frames: steps K of a window.
        embed_dim: width of a token.
        patch_size: patch of the inner transformer; the whole observation if None.
        num_blocks_inner: number of inner blocks.
        num_heads_inner: attention heads of an inner block.
        ffn_expansion_inner: hidden width of an inner block's FFN as a multiple of the width.
        activation_inner: activation in an inner block's FFN.
        position_encoding: whether patches and class token get a learned position encoding.
        **hyperparameters: fields of :class:`DecisionTransformer`.
    """
    inner = encoders.Inner(
        patch_size=patch_size,
        embed_dim=embed_dim,
        num_blocks=num_blocks_inner,
        num_heads=num_heads_inner,
        ffn_expansion=ffn_expansion_inner,
        activation=activation_inner,
        position_encoding=position_encoding,
        every_block=False,
    )
    return replace(
        decision_transformer(num_frames, embed_dim=embed_dim, **hyperparameters), frame=inner
    )


NETWORKS: dict[str, Callable[..., Network]] = {
    "enhanced-tit": enhanced_tit,
    "vanilla-tit": vanilla_tit,
    "nature-cnn": nature_cnn,
    "resnet": resnet,
    "catformer": catformer,
    "coberl": coberl,
    "gtrxl": gtrxl,
    "mlp": mlp,
    "ofenet": ofenet,
    "d2rl": d2rl,
    "lstm": lstm,
    "gru": gru,
    "mingru": mingru,
    "gated-deltanet": gated_deltanet,
    "mamba2": mamba2,
    "decision-transformer": decision_transformer,
    "dt-tit": dt_tit,
}
"""The systems of the paper, GTrXL and recurrent networks by name: each is a pair of encoders."""


def _on_images(
    num_frames: int, embed_dim: int, history: HistorySettings, features_dim: int | None
) -> Network:
    """A residual network on each image, a history encoder, and a head with relu, if any."""
    activation: Activation = "tanh" if features_dim is None else "relu"
    return Network(
        frame=encoders.ResNetFrames(embed_dim=embed_dim),
        history=history,
        head=Head(features_dim=features_dim, activation=activation),
        num_frames=num_frames,
    )


def _separate(num_frames: int, history: HistorySettings) -> Network:
    """Layers on the entries of K observations, without a head, separate for policy and value."""
    return Network(
        frame=encoders.Flat(),
        history=history,
        head=Head(features_dim=None),
        num_frames=num_frames,
        trunks="separate",
    )
