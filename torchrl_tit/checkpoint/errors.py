"""What goes wrong with checkpoints."""

from __future__ import annotations


class CheckpointError(OSError):
    """A checkpoint could not be written or must not be used; the message says why and what to do.

    Example:
        >>> issubclass(CheckpointError, OSError)
        True
    """


class CheckpointNotFoundError(CheckpointError, FileNotFoundError):
    """There is no checkpoint where one was asked for.

    Example:
        >>> issubclass(CheckpointNotFoundError, FileNotFoundError)
        True
    """
