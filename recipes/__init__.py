"""Experiments: settings, algorithms, one training loop, and a command line."""
