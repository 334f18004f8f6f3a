"""The command line: main.py names the commands, each of which parses its arguments and runs."""

from .main import main

__all__ = ["main"]
