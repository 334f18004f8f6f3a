"""PPO with any backbone: settings in recipe.py, the loop in training.py, and named recipes."""

from .recipe import PPO

__all__ = ["PPO"]
