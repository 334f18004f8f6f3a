"""Errors of checkpoints."""

from __future__ import annotations


class CheckpointError(OSError):
    """A checkpoint cannot be written or used; the message says why and what to do.

    Example:
        >>> issubclass(CheckpointError, OSError)
        True
    """


class CheckpointNotFoundError(CheckpointError, FileNotFoundError):
    """The requested checkpoint does not exist.

    Example:
        >>> issubclass(CheckpointNotFoundError, FileNotFoundError)
        True
    """
