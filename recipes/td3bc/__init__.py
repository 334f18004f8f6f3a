"""TD3+BC with any backbone: settings in settings.py, the algorithm in algorithm.py."""

from .settings import TD3BC

__all__ = ["TD3BC"]
