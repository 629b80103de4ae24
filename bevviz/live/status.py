"""Status of a run: messages to the user, latencies, CPU and memory, and the robot's /diagnostics."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from bevviz.live.graph import open_publisher
from bevviz.live.node import add_timer
from bevviz.live.problems import Problem
from bevviz.messages.definitions import typestore
from bevviz.messages.encode import make_header, make_message
from bevviz.messages.surroundings import LEVELS
from bevviz.model.results import FrameResult
from bevviz.recording import entities

RECENT = 100  # frames that percentiles are taken over
SAMPLE = 1.0  # seconds between two looks at CPU and memory
LONGEST = 60.0  # seconds; a latency beyond it, or below zero, comes from a clock that jumped
JUMP = 0.5  # seconds of drift against the monotonic clock that count as a jump
DIAGNOSTICS = "/diagnostics"
TYPE = "diagnostic_msgs/msg/DiagnosticArray"
PERIOD = 1.0  # seconds, the usual period of diagnostic_updater
OK, WARN, ERROR = range(3)


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


class Diagnostics:
    """Publisher of the state of the run, each second, with or without frames.

    ``NAME: pipeline`` has latencies, drops and failed stages. ``NAME: anomalies`` has the anomalies of the
    newest frame. ``NAME: sources`` has the current problems, with the seconds that they have lasted.

    Args:
        node: an rclpy node, whose remaps apply.

    Raises:
        UserError: the message type is unknown, or another node publishes the topic with another type.
    """

    def __init__(self, node: Any) -> None:
        self._node, self._name = node, node.get_name()
        self._publisher = open_publisher(node, TYPE, DIAGNOSTICS, shared=True)
        self._result: FrameResult | None = None
        self._at = 0.0

    def every_second(self, publish: Callable[[], None]) -> None:
        """Make a timer of the node call ``publish``. That function calls the method ``publish``."""
        add_timer(self._node, PERIOD, publish)

    def observe(self, result: FrameResult) -> None:
        """Store the newest result. Any thread may call it."""
        self._result, self._at = result, time.monotonic()

    def publish(self, numbers: Mapping[str, float], problems: Sequence[Problem]) -> None:
        """Publish the current state.

        Args:
            numbers: numbers of the run, by name.
            problems: the current problems.
        """
        more = f" (and {len(problems) - 1} more)" if problems[1:] else ""
        text = f"{problems[0]}{more}" if problems else ""
        listed = {
            f"{problem.finding.kind} {problem.finding.subject}": (
                f"{problem} (for {time.time() - problem.since:.0f} s)"
            )
            for problem in problems
        }
        sources = self._status("sources", WARN if problems else OK, text, listed)
        statuses = [self._pipeline(numbers), self._anomalies(), sources]
        now = time.time_ns()
        message = make_message(TYPE, header=make_header(now, ""), status=statuses)
        self._publisher.publish(bytes(typestore().serialize_cdr(message, TYPE)))

    def _pipeline(self, numbers: Mapping[str, float]) -> Any:
        result = self._result
        values = {name: f"{value:.1f}".removesuffix(".0") for name, value in numbers.items()}
        if result is None:
            return self._status("pipeline", WARN, "no frame yet", values)
        age = time.monotonic() - self._at
        if age > 2 * PERIOD:
            return self._status("pipeline", ERROR, f"no frame for {age:.0f} s", values)
        if result.failures:
            failure = result.failures[0]
            return self._status("pipeline", ERROR, f"{failure.stage} fails: {failure.reason}", values)
        problems = [*result.frame.problems, *(p for c in result.cameras for p in c.camera.problems)]
        return self._status("pipeline", WARN if problems else OK, problems[0] if problems else "", values)

    def _anomalies(self) -> Any:
        anomalies = self._result.anomalies if self._result is not None else ()
        text = anomalies[0].text if anomalies else ""
        level = ERROR if any(a.severity == "ERROR" for a in anomalies) else WARN if anomalies else OK
        return self._status("anomalies", level, text, {f"{a.kind} {a.subject}": a.text for a in anomalies})

    def _status(self, part: str, level: int, text: str, values: Mapping[str, str]) -> Any:
        pairs = [make_message("diagnostic_msgs/msg/KeyValue", key=k, value=v) for k, v in values.items()]
        return make_message(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name=f"{self._name}: {part}",
            message=text or LEVELS[level],
            values=pairs,
        )
