"""Networks: plain ``nn.Module``s, tensors in, tensors out."""

from torchrl_tit.networks.by_kind import chosen_by_kind, frames_by_kind
from torchrl_tit.networks.history_network import (
    AttentionMaps,
    HistoryNetwork,
    TwoTrunks,
    build_network,
)
from torchrl_tit.networks.masked_predictions import masked_predictions
from torchrl_tit.networks.systems import (
    D2RL,
    DTTIT,
    MLP,
    Catformer,
    CoBERL,
    DecisionTransformer,
    EnhancedTIT,
    GTrXL,
    NatureCNN,
    OFENet,
    ResNet,
    VanillaTIT,
)

__all__ = [
    "D2RL",
    "DTTIT",
    "MLP",
    "AttentionMaps",
    "Catformer",
    "CoBERL",
    "DecisionTransformer",
    "EnhancedTIT",
    "GTrXL",
    "HistoryNetwork",
    "NatureCNN",
    "OFENet",
    "ResNet",
    "TwoTrunks",
    "VanillaTIT",
    "build_network",
    "chosen_by_kind",
    "frames_by_kind",
    "masked_predictions",
]
