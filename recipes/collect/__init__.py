"""`data collect`: data sets of a task, made the way D4RL's were. Begin with collect.py."""

from .settings import Collection

__all__ = ["Collection"]
