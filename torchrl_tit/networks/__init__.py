"""Networks: plain ``nn.Module``s, tensors in, tensors out."""

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
    "HistoryNetwork",
    "NatureCNN",
    "OFENet",
    "ResNet",
    "TwoTrunks",
    "VanillaTIT",
    "build_network",
    "masked_predictions",
]
