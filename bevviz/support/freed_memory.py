"""Memory that a long run frees goes back to the system."""

from __future__ import annotations

import ctypes
import platform
from contextlib import suppress

_ARENA_MAX, _MMAP_THRESHOLD = -8, -3  # parameters of glibc's mallopt
_ARENAS = 2  # heaps of all threads together; glibc takes eight for each core
_LARGE = 2_000_000  # bytes of a block that is unmapped when it is freed; frames have many arrays of 1 MB


def return_freed_memory() -> None:
    """Make the C library return large blocks when they are freed. Call it before threads start.

    By default glibc keeps blocks of up to 32 MB, in a heap for each thread. The pages of a drive are answered
    by many threads, each with arrays of a frame. Beside a robot, packets and messages that are kept for
    seconds leave gaps in the heap, which grows by megabytes a minute. Another C library stays as it is.
    """
    if platform.libc_ver()[0] != "glibc":
        return
    with suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.mallopt(_ARENA_MAX, _ARENAS)
        library.mallopt(_MMAP_THRESHOLD, _LARGE)
