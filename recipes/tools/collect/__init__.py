"""`data collect`: data sets of a task, made the way D4RL's were. Start reading at collect.py."""

from .settings import Collection

__all__ = ["Collection"]
