"""Decision Transformer, offline in dt.py, and Online Decision Transformer in odt.py."""

from .dt import DT
from .odt import ODT

__all__ = ["DT", "ODT"]
