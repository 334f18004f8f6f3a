"""Behaviour cloning with any backbone: settings in settings.py, the algorithm in algorithm.py."""

from .settings import BC

__all__ = ["BC"]
