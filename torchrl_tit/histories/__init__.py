"""History encoders, which map the tokens of K frames to one vector."""

from torchrl_tit.histories.encoder import HistoryEncoder, HistoryShape, OneToken, RecurrentEncoder

__all__ = ["HistoryEncoder", "HistoryShape", "OneToken", "RecurrentEncoder"]
