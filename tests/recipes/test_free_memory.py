"""Freed memory is returned to the system."""

import ctypes
import platform
from pathlib import Path

import pytest

from recipes.core.runner import return_free_memory

BLOCK, COUNT = 100_000, 1_000  # bytes; smaller than what glibc takes from the system piece by piece


def own_memory():
    lines = Path("/proc/self/status").read_text().splitlines()
    fields = dict(line.split(":", 1) for line in lines)
    return int(fields["RssAnon"].split()[0]) * 1024


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc has malloc_trim")
def test_memory_between_blocks_in_use_is_returned():
    libc = ctypes.CDLL(None)
    libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
    libc.free.argtypes = [ctypes.c_void_p]
    blocks = [libc.malloc(BLOCK) for _ in range(COUNT)]
    for block in blocks:
        ctypes.memset(block, 1, BLOCK)
    last = blocks.pop()  # in use: what lies before it cannot be given back from the end
    for block in blocks:
        libc.free(block)
    kept = own_memory()
    return_free_memory()
    returned = kept - own_memory()
    libc.free(last)
    assert returned > 0.8 * BLOCK * COUNT
