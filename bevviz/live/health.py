"""How the process itself does: latencies, drops, CPU and memory."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from pathlib import Path

import numpy as np

from bevviz.recording import entities

RECENT = 100  # frames that percentiles are taken over
SAMPLE = 1.0  # seconds between two looks at CPU and memory
LONGEST = 60.0  # seconds; a latency beyond it, or below zero, is a clock that jumped
JUMP = 0.5  # seconds that the clock may be off its course


class Health:
    """Call ``logged`` for each frame; ``scalars`` are for the next one."""

    def __init__(self) -> None:
        self.latencies: deque[float] = deque(maxlen=RECENT)  # seconds
        self.histogram = np.zeros(1001, np.int64)  # of all latencies, in ms; the last holds what is longer
        self.cpu = 0.0  # percent of one core
        self.memory = 0.0  # MB
        self._sampled = time.monotonic()
        self._busy = time.process_time()
        self._course = time.time() - time.monotonic()

    def logged(self, received: int) -> None:
        """A frame whose cloud was received at this time (nanoseconds since 1970) is with every output."""
        latency = time.time() - received * 1e-9
        if 0 <= latency < LONGEST:
            self.latencies.append(latency)
            self.histogram[min(int(1e3 * latency), 1000)] += 1

    def percentile(self, percent: float) -> float:
        """Seconds from arrival to logged; NaN before the first frame."""
        return float(np.percentile(self.latencies, percent)) if self.latencies else float("nan")

    def scalars(self) -> dict[str, float]:
        self._sample()
        return {
            entities.latency("p50"): 1e3 * self.percentile(50),
            entities.latency("p99"): 1e3 * self.percentile(99),
            entities.process("cpu_percent"): self.cpu,
            entities.process("memory_mb"): self.memory,
        }

    def clock_jump(self) -> float:
        """Seconds that the clock has jumped since the last call; 0 where it has not."""
        course = time.time() - time.monotonic()
        jump, self._course = course - self._course, course
        return jump if abs(jump) > JUMP else 0.0

    def _sample(self) -> None:
        now, busy = time.monotonic(), time.process_time()
        if now - self._sampled < SAMPLE and self.memory:
            return
        self.cpu = 100 * (busy - self._busy) / max(now - self._sampled, 1e-9)
        self.memory = memory()
        self._sampled, self._busy = now, busy


def memory() -> float:
    """MB of this process that are in memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def give_way() -> None:
    """This thread does what has time: everything else on this machine goes first."""
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 19)


def set_nice(nice: int) -> None:
    """Of every thread: on Linux each has its own.

    Raises:
        PermissionError: only root may take priority back.
    """
    for task in Path("/proc/self/task").iterdir():
        os.setpriority(os.PRIO_PROCESS, int(task.name), nice)
