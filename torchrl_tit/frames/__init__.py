"""Frame encoders, which map one observation to tokens, in the same way at every step."""

from torchrl_tit.frames.encoder import FrameEncoder
from torchrl_tit.frames.normalized import NormalizedFrames, share_statistics
from torchrl_tit.frames.observation import Observation, read_observation, read_observations

__all__ = [
    "FrameEncoder",
    "NormalizedFrames",
    "Observation",
    "read_observation",
    "read_observations",
    "share_statistics",
]
