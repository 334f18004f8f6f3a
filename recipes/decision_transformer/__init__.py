"""Decision Transformer, offline in dt.py, and Online Decision Transformer in odt.py."""

from .settings import DT, ODT

__all__ = ["DT", "ODT"]
