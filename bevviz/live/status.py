"""Status of a run: messages to the user, latencies, CPU and memory."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from bevviz.recording import entities

RECENT = 100  # frames that percentiles are taken over
SAMPLE = 1.0  # seconds between two looks at CPU and memory
LONGEST = 60.0  # seconds; a latency beyond it, or below zero, comes from a clock that jumped
JUMP = 0.5  # seconds of drift against the monotonic clock that count as a jump


class Notes:
    """Collector of messages to the user, one sentence each. Any thread may use it.

    Args:
        say: prints a line.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._lock = threading.Lock()
        self._waiting: list[tuple[str, str]] = []

    def info(self, text: str) -> None:
        """Print and record a sentence."""
        self._add("INFO", text, text)

    def warn(self, text: str) -> None:
        """Print and record a warning."""
        self._add("WARN", text, f"warning: {text}")

    def take(self) -> list[tuple[str, str]]:
        """Return level and text of the messages since the last call."""
        with self._lock:
            taken, self._waiting = self._waiting, []
        return taken

    def _add(self, level: str, text: str, line: str) -> None:
        with self._lock:
            self._waiting.append((level, text))
            del self._waiting[:-100]  # keeps the list short while no frame takes the messages
        self._say(line)


class Health:
    """Meter of latencies, CPU and memory.

    Call ``logged`` for each frame. Log ``scalars`` with the next frame.
    """

    def __init__(self) -> None:
        self.latencies: deque[float] = deque(maxlen=RECENT)  # seconds
        self.histogram = np.zeros(1001, np.int64)  # all latencies, bins of 1 ms; the last is open
        self.cpu = 0.0  # percent of one core
        self.memory = 0.0  # MB
        self._sampled = time.monotonic()
        self._busy = time.process_time()
        self._course = time.time() - time.monotonic()

    def logged(self, received: int) -> None:
        """Record the latency of a frame that every output has.

        Args:
            received: time of receipt of its cloud, nanoseconds since 1970.
        """
        latency = time.time() - received * 1e-9
        if 0 <= latency < LONGEST:
            self.latencies.append(latency)
            self.histogram[min(int(1e3 * latency), 1000)] += 1

    def percentile(self, percent: float) -> float:
        """Return a percentile of the seconds from arrival to logged. It is NaN before the first frame."""
        return float(np.percentile(self.latencies, percent)) if self.latencies else float("nan")

    def scalars(self) -> dict[str, float]:
        """Return the values to log, by entity path. Latencies are in ms."""
        self._sample()
        return {
            entities.LATENCY.path("p50"): 1e3 * self.percentile(50),
            entities.LATENCY.path("p99"): 1e3 * self.percentile(99),
            entities.PROCESS.path("cpu_percent"): self.cpu,
            entities.PROCESS.path("memory_mb"): self.memory,
        }

    def clock_jump(self) -> float:
        """Return the seconds that the clock has jumped since the last call, or 0."""
        course = time.time() - time.monotonic()
        jump, self._course = course - self._course, course
        return jump if abs(jump) > JUMP else 0.0

    def _sample(self) -> None:
        """Measure CPU and memory, at most once in ``SAMPLE``."""
        now, busy = time.monotonic(), time.process_time()
        if now - self._sampled < SAMPLE and self.memory:
            return
        self.cpu = 100 * (busy - self._busy) / max(now - self._sampled, 1e-9)
        self.memory = memory()
        self._sampled, self._busy = now, busy


def memory() -> float:
    """Return the resident memory of this process in MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def give_way() -> None:
    """Give the current thread the lowest priority."""
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 19)


def set_nice(nice: int) -> None:
    """Set the priority of every thread of this process. On Linux each thread has its own.

    Raises:
        PermissionError: only root may raise the priority again.
    """
    for task in Path("/proc/self/task").iterdir():
        with suppress(ProcessLookupError):  # the thread has ended meanwhile
            os.setpriority(os.PRIO_PROCESS, int(task.name), nice)
