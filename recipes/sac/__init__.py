"""SAC with any backbone: settings in settings.py, the algorithm in algorithm.py."""

from .settings import SAC

__all__ = ["SAC"]
