"""TorchRL transforms: the last K observations, and observations with hidden entries."""

from __future__ import annotations

from torchrl_tit.transforms.hide_velocities import VELOCITIES, HideEntries, HideVelocities
from torchrl_tit.transforms.history import History, frames_before
from torchrl_tit.transforms.sequence_history import SequenceHistory

__all__ = [
    "VELOCITIES",
    "HideEntries",
    "HideVelocities",
    "History",
    "SequenceHistory",
    "frames_before",
]
