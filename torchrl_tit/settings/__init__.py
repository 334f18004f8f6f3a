"""Settings: dataclasses with checks that import neither torch nor the modules they build.

Listing recipes and printing help only needs names, defaults and docstrings, so settings are kept
apart from modules. Each part names its implementation, which is imported when the part is built
(:meth:`~torchrl_tit.settings.parts.Part.build`).
"""

from torchrl_tit.settings.frames import (
    Activation,
    Flat,
    FrameSettings,
    Inner,
    Linear,
    NatureCNNFrames,
    ResNetFrames,
)
from torchrl_tit.settings.histories import (
    D2RL,
    GRU,
    LSTM,
    MLP,
    Catformer,
    ChainedOuter,
    CoBERL,
    DecisionTransformer,
    GTrXL,
    HistorySettings,
    OFENet,
    Outer,
    PairedOuter,
    StackedCNN,
    StackedInner,
    TemporalPositions,
)
from torchrl_tit.settings.networks import NETWORKS, Head, Network
from torchrl_tit.settings.parts import Part, resolve
from torchrl_tit.settings.per_key import PerKey

__all__ = [
    "D2RL",
    "GRU",
    "LSTM",
    "MLP",
    "NETWORKS",
    "Activation",
    "Catformer",
    "ChainedOuter",
    "CoBERL",
    "DecisionTransformer",
    "Flat",
    "FrameSettings",
    "GTrXL",
    "Head",
    "HistorySettings",
    "Inner",
    "Linear",
    "NatureCNNFrames",
    "Network",
    "OFENet",
    "Outer",
    "PairedOuter",
    "Part",
    "PerKey",
    "ResNetFrames",
    "StackedCNN",
    "StackedInner",
    "TemporalPositions",
    "resolve",
]
