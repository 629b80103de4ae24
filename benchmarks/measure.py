"""How things are timed: both sides of a comparison take turns, so that the machine's moods meet both."""

from __future__ import annotations

import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from threading import Thread


@dataclass(frozen=True, slots=True)
class Times:
    """Seconds of each repetition."""

    all: Sequence[float]

    @property
    def median(self) -> float:
        return median(self.all)

    @property
    def best(self) -> float:
        return min(self.all)

    def __str__(self) -> str:
        scale, unit = (1, "s") if self.best > 0.1 else (1e3, "ms")
        return f"{scale * self.median:.3g} {unit} ({scale * self.best:.3g})"


def interleaved(repetitions: int, *sides: Callable[[], object]) -> list[Times]:
    """Run the sides in turns. Each is run once before, so that nothing is compiled or loaded meanwhile."""
    for side in sides:
        side()
    times: list[list[float]] = [[] for _ in sides]
    for _ in range(repetitions):
        for found, side in zip(times, sides, strict=True):
            start = time.perf_counter()
            side()
            found.append(time.perf_counter() - start)
    return [Times(found) for found in times]


@dataclass(frozen=True, slots=True)
class Finished:
    seconds: float
    processor: float  # seconds of processor time of all its threads
    memory: float  # MB at most, in the process's own pages


def run(*command: str) -> Finished:
    """Run a program of this environment to its end.

    Raises:
        SystemExit: it failed.
    """
    program = Path(sys.executable).with_name(command[0])
    with tempfile.TemporaryFile() as said:
        start, used = time.perf_counter(), children_time()
        process = subprocess.Popen([program, *command[1:]], stdout=subprocess.DEVNULL, stderr=said)
        # Not what wait4 tells: a child that was forked has its parent's peak in it.
        looks: list[float] = [0.0]
        watch = Thread(target=_watch, args=(process, looks))
        watch.start()
        process.wait()
        seconds = time.perf_counter() - start
        watch.join()
        if process.returncode != 0:
            said.seek(0)
            raise SystemExit(f"{' '.join(command)}: {said.read().decode().strip()}")
    return Finished(seconds, children_time() - used, max(looks))


def _watch(process: subprocess.Popen[bytes], looks: list[float]) -> None:
    while process.returncode is None:
        looks.append(peak_memory(process.pid))
        time.sleep(0.02)


def peak_memory(pid: int) -> float:
    """Return the most memory in MB that a running process had so far; 0 where it cannot be told."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0.0
    found = [line for line in status.splitlines() if line.startswith("VmHWM:")]
    return int(found[0].split()[1]) / 1e3 if found else 0.0


def children_time() -> float:
    """Seconds of processor time of all processes that this one has run to their end."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def machine() -> str:
    """Processor, cores and Python version in a line."""
    info = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
    names = [line.partition(":")[2].strip() for line in info.splitlines() if line.startswith("model name")]
    name = names[0] if names else platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"


def default_model() -> Path | None:
    """Return YOLOX-nano among the data beside the project. None: there is none."""
    model = Path(__file__).resolve().parents[2] / "shared/data/models/yolox_nano.onnx"
    return model if model.exists() else None
