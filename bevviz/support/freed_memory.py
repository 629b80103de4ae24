"""Memory that a long-lived server frees goes back to the system."""

from __future__ import annotations

import ctypes
import platform
from contextlib import suppress

_ARENA_MAX, _MMAP_THRESHOLD = -8, -3  # parameters of glibc's mallopt
_ARENAS = 2  # heaps of all threads together; glibc takes eight for each core
_LARGE = 4 << 20  # bytes of a block that is unmapped as soon as it is freed


def return_freed_memory() -> None:
    """Make the C library return large blocks when they are freed. Call it before threads start.

    By default glibc keeps blocks of up to 32 MB, in a heap for each thread. The pages of a drive are answered
    by many threads, each with arrays of a frame. Another C library stays as it is.
    """
    if platform.libc_ver()[0] != "glibc":
        return
    with suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.mallopt(_ARENA_MAX, _ARENAS)
        library.mallopt(_MMAP_THRESHOLD, _LARGE)
