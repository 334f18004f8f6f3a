"""Losses that TorchRL lacks or implements differently."""

from torchrl_tit.objectives.behavior_cloning import LikelihoodBCLoss
from torchrl_tit.objectives.contrastive import contrastive_prediction_loss
from torchrl_tit.objectives.cql import ContinuousCQLLoss, DelayedDiscreteCQLLoss
from torchrl_tit.objectives.decision_transformer import MaskedDTLoss

__all__ = [
    "ContinuousCQLLoss",
    "DelayedDiscreteCQLLoss",
    "LikelihoodBCLoss",
    "MaskedDTLoss",
    "contrastive_prediction_loss",
]
