"""Networks: plain ``nn.Module``s, tensors in, tensors out."""

from torchrl_tit.networks import named
from torchrl_tit.networks.by_kind import chosen_by_kind, frames_by_kind
from torchrl_tit.networks.history_network import (
    HistoryNetwork,
    TwoTrunks,
    build_network,
    masked_predictions,
)
from torchrl_tit.networks.named import *  # noqa: F403

__all__ = [
    *named.__all__,
    "HistoryNetwork",
    "TwoTrunks",
    "build_network",
    "chosen_by_kind",
    "frames_by_kind",
    "masked_predictions",
]
