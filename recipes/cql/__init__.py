"""Conservative Q-learning: settings in settings.py, code in algorithm.py and discrete.py."""

from .settings import CQL, DiscreteCQL

__all__ = ["CQL", "DiscreteCQL"]
