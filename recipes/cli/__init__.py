"""The command line: main.py lists the commands; each parses its arguments and runs."""

from .main import main

__all__ = ["main"]
