"""Losses that TorchRL lacks or has otherwise."""

from torchrl_tit.objectives.contrastive import contrastive_prediction_loss
from torchrl_tit.objectives.cql import ContinuousCQLLoss, PolicySamples
from torchrl_tit.objectives.decision_transformer import MaskedDTLoss
from torchrl_tit.objectives.discrete_cql import DelayedDiscreteCQLLoss

__all__ = [
    "ContinuousCQLLoss",
    "DelayedDiscreteCQLLoss",
    "MaskedDTLoss",
    "PolicySamples",
    "contrastive_prediction_loss",
]
