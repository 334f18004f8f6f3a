"""Frame encoders: one observation to tokens, the same way at every step."""

from torchrl_tit.frames.encoder import FrameEncoder

__all__ = ["FrameEncoder"]
