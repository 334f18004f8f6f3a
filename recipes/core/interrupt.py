"""Stopping a run without losing work."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupt:
    """Turns the first Ctrl-C (or SIGTERM) into a request that the training loop reads.

    The loop completes its batch, saves a checkpoint and stops. A second Ctrl-C stops at once, with
    the last checkpoint kept. A RuntimeError in the batch also stops at once, because the first
    Ctrl-C also interrupts a C++ compiler that the batch may be running.

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

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        if self.requested and isinstance(error, RuntimeError):
            raise KeyboardInterrupt from error

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
        print(
            "\nsaving a checkpoint after this batch; press Ctrl-C again to stop at once",
            file=sys.stderr,
        )


@contextmanager
def raise_on_signals() -> Iterator[None]:
    """Lets SIGTERM raise KeyboardInterrupt as Ctrl-C does, so that workers are stopped too.

    SIGINT raises it too, even if the process started in the background, ignoring SIGINT.

    Example:
        >>> with raise_on_signals():
        ...     signal.getsignal(signal.SIGTERM) is signal.default_int_handler
        True
    """
    previous = {s: signal.signal(s, signal.default_int_handler) for s in _SIGNALS}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


_SIGNALS = (signal.SIGINT, signal.SIGTERM)
