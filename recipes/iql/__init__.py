"""Implicit Q-learning with any backbone: settings in settings.py, the code in algorithm.py."""

from .settings import IQL

__all__ = ["IQL"]
