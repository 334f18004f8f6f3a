"""Stopping a run in good order."""

from __future__ import annotations

import signal
import sys
from types import FrameType


class Interrupt:
    """Turns the first Ctrl-C (or SIGTERM) into a request that the training loop reads.

    The loop ends its batch, saves a checkpoint and stops. A second Ctrl-C stops at once; the last
    checkpoint is still there then.

    Example:
        >>> with Interrupt() as interrupt:
        ...     interrupt.requested
        False
    """

    def __init__(self) -> None:
        self.requested = False

    def __enter__(self) -> Interrupt:
        self._previous = {s: signal.signal(s, self._handle) for s in _SIGNALS}
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        print("\nsaving a checkpoint after this batch; again to stop at once", file=sys.stderr)


_SIGNALS = (signal.SIGINT, signal.SIGTERM)
