"""TorchRL transforms: the last K observations for a network, and observations with gaps."""

from torchrl_tit.transforms.hide_velocities import VELOCITIES, HideEntries, HideVelocities
from torchrl_tit.transforms.history import History
from torchrl_tit.transforms.sequence_history import SequenceHistory

__all__ = ["VELOCITIES", "HideEntries", "HideVelocities", "History", "SequenceHistory"]
