"""DQN with any backbone: settings in settings.py, the algorithm in algorithm.py."""

from .settings import DQN

__all__ = ["DQN"]
