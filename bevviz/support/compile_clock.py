"""Clocks that stand still while loops are compiled."""

from __future__ import annotations

import threading
import time


class CompileTimer:
    """Time spent on compiling, or on loading compiled code: by the current thread, and by all threads."""

    def __init__(self) -> None:
        self._local = threading.local()
        self.everywhere = 0.0

    @property
    def here(self) -> float:
        """Seconds of the current thread."""
        return getattr(self._local, "seconds", 0.0)

    def start(self) -> None:
        """Start the clock of this thread, unless it compiles already."""
        depth = getattr(self._local, "depth", 0)
        if not depth:
            self._local.start = time.perf_counter()
        self._local.depth = depth + 1

    def stop(self) -> None:
        """Add the time of the outermost compilation."""
        self._local.depth -= 1
        if not self._local.depth:
            seconds = time.perf_counter() - self._local.start
            self._local.seconds = self.here + seconds
            self.everywhere += seconds


compile_timer = CompileTimer()


def thread_clock() -> float:
    """Return seconds, as ``time.perf_counter``, without the time in which this thread compiled."""
    return time.perf_counter() - compile_timer.here


def common_clock() -> float:
    """Return seconds without the time in which any thread compiled.

    If one thread waits for another to compile, the time counts twice.
    """
    return time.perf_counter() - compile_timer.everywhere
