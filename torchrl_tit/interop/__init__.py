"""Loads networks and weights of the authors' release."""

from torchrl_tit.interop.official import from_official

__all__ = ["from_official"]
