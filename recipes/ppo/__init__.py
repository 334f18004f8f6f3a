"""PPO with any backbone: settings in settings.py, the algorithm in algorithm.py."""

from .settings import PPO

__all__ = ["PPO"]
