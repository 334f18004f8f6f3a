"""The command line: main.py knows the commands, which read their words and call the rooms."""

from .main import main

__all__ = ["main"]
