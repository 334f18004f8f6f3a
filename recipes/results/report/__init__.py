"""Reports: everything about one or several runs as one HTML file."""

from .report import report

__all__ = ["report"]
