"""Conservative Q-learning: settings and gradient steps in continuous.py and discrete.py."""

from .continuous import CQL
from .discrete import DiscreteCQL

__all__ = ["CQL", "DiscreteCQL"]
