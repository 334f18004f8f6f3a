"""Losses that TorchRL lacks or has otherwise."""

from torchrl_tit.objectives.decision_transformer import MaskedDTLoss

__all__ = ["MaskedDTLoss"]
