"""`data collect`: data sets of a task, made the way D4RL's were. Begin with data_sets.py."""

from .data_sets import collect
from .settings import Collection

__all__ = ["Collection", "collect"]
