"""Experiments as data: dataclasses that assemble them, each beside the loop that it drives."""
