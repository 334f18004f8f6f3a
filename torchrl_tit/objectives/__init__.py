"""Losses that TorchRL lacks or implements differently."""

from torchrl_tit.objectives.behaviour_cloning import LikelihoodBCLoss
from torchrl_tit.objectives.contrastive import contrastive_prediction_loss
from torchrl_tit.objectives.cql import ContinuousCQLLoss
from torchrl_tit.objectives.cql_terms import PolicySamples
from torchrl_tit.objectives.decision_transformer import MaskedDTLoss
from torchrl_tit.objectives.discrete_cql import DelayedDiscreteCQLLoss
from torchrl_tit.objectives.pairs import encode_pairs

__all__ = [
    "ContinuousCQLLoss",
    "DelayedDiscreteCQLLoss",
    "LikelihoodBCLoss",
    "MaskedDTLoss",
    "PolicySamples",
    "contrastive_prediction_loss",
    "encode_pairs",
]
