"""Memory that the C allocator keeps after it was freed."""

from __future__ import annotations

import ctypes
import sys


def return_free_memory() -> None:
    """Returns freed memory to the system, where the C library is glibc; elsewhere does nothing.

    Between two blocks that are in use, glibc keeps what was freed, and a run that frees and
    allocates tensors of changing sizes grows for hours although it uses no more. See
    ``man 3 malloc_trim``.

    Example:
        >>> return_free_memory()
    """
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
