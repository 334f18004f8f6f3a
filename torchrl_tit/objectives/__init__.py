"""Losses that TorchRL lacks or has otherwise."""

from torchrl_tit.objectives.contrastive import contrastive_prediction_loss
from torchrl_tit.objectives.cql import ContinuousCQLLoss
from torchrl_tit.objectives.cql_terms import PolicySamples
from torchrl_tit.objectives.decision_transformer import MaskedDTLoss
from torchrl_tit.objectives.discrete_cql import DelayedDiscreteCQLLoss
from torchrl_tit.objectives.stacked_cql import StackedCQLLoss

__all__ = [
    "ContinuousCQLLoss",
    "DelayedDiscreteCQLLoss",
    "MaskedDTLoss",
    "PolicySamples",
    "StackedCQLLoss",
    "contrastive_prediction_loss",
]
