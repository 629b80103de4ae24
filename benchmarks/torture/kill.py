"""Processes that are interrupted, terminated and killed at any time, from the first instant on."""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tests import bags

SCANS = 40
LIMIT = 120.0  # seconds for a command, undisturbed or after its signal
ROOT = Path(__file__).resolve().parents[2]
# Before the first of our modules runs, Python says what it likes.
OURS = re.compile(r"bevviz/(?!__init__|__main__)\w")
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
COMMANDS: Mapping[str, tuple[str, ...]] = {
    "bag": ("bag", "drive", "--save", "out.rrd"),
    "report": ("report", "drive", "--at", "2", "-o", "bug.rrd", "--force"),
    "report --check": ("report", "--check", "checked.rrd"),
    "batch": ("batch", "drive", "-o", "runs", "--jobs", "1"),
}


@dataclass
class Killed:
    """What came of the signals that a command was sent."""

    signals: int = 0
    ended: int = 0  # before the signal came, or had not begun when it did
    tracebacks: int = 0
    false: int = 0  # a status or a result that is not true
    hangs: int = 0
    unreadable: int = 0  # files under the name of a whole one, or of an unfinished one
    lost: int = 0  # the same command, run again, does not end well
    slowest: float = 0.0  # seconds from an interrupt to the end
    examples: list[str] = field(default_factory=list)

    @property
    def well(self) -> bool:
        return not (self.tracebacks or self.false or self.hangs or self.unreadable or self.lost)


HEAD = """| command | signals | not running | tracebacks | false | hangs | unreadable | lost | s to the end |
| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"""


def row(name: str, k: Killed) -> str:
    return (
        f"| {name} | {k.signals} | {k.ended} | {k.tracebacks} | {k.false} | {k.hangs} | {k.unreadable} | "
        f"{k.lost} | {k.slowest:.1f} |"
    )


def run(seed: int, count: int, names: Sequence[str] = tuple(COMMANDS)) -> Iterator[tuple[str, Killed]]:
    """Send each of the commands its share of ``count`` signals."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bags.write(folder / "drive", bags.small_items(scans=SCANS))
        _finish(folder, "report", "drive", "--at", "2", "-o", "checked.rrd")
        for number, command in enumerate(names):
            began = time.monotonic()
            _finish(folder, *COMMANDS[command])
            duration = time.monotonic() - began
            tally = Killed()
            for _ in range(count // len(names) + (number < count % len(names))):
                # Half of them in the first half second, where everything is imported.
                latest = 0.5 if rng.random() < 0.5 else 1.1 * duration
                _one(folder, command, rng.choice(SIGNALS), rng.uniform(0, latest), tally)
            yield command, tally


def _one(folder: Path, command: str, number: signal.Signals, delay: float, tally: Killed) -> None:
    for made in ("out.rrd", "out.partial.rrd", "bug.rrd", "bug.mcap", "bug.html", "runs"):
        path = folder / made
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    process = _start(folder, *COMMANDS[command])
    time.sleep(delay)
    what = f"{command}, {number.name} after {delay:.3f} s"
    tally.signals += 1
    sent = time.monotonic()
    tally.ended += process.poll() is not None
    process.send_signal(number)
    try:
        out, said = process.communicate(timeout=LIMIT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        tally.hangs += 1
        tally.examples.append(f"{what}: hangs")
        return
    if number != signal.SIGKILL:
        tally.slowest = max(tally.slowest, time.monotonic() - sent)
    if ("Traceback" in said or "Fatal Python error" in said) and not OURS.search(said):
        tally.ended += 1
        return
    if "Traceback" in said:
        tally.tracebacks += 1
        tally.examples.append(f"{what}: {said.strip().splitlines()[-1]}")
    if problem := _falsehood(folder, command, process.returncode, out):
        tally.false += 1
        tally.examples.append(f"{what}: status {process.returncode}, {problem}")
    for path in [*folder.glob("*.rrd"), *folder.glob("runs/*.rrd")]:
        if problem := _unreadable(path):
            tally.unreadable += 1
            tally.examples.append(f"{what}: {path.name}: {problem}")
    if number == signal.SIGKILL:
        try:
            _finish(folder, *COMMANDS[command])
        except RuntimeError as error:
            tally.lost += 1
            tally.examples.append(f"{what}: then {error}")


def _falsehood(folder: Path, command: str, status: int, out: str) -> str:
    """What is not true of a status and what it vouches for; empty where all is."""
    if status not in (0, 130, -signal.SIGINT, -signal.SIGTERM, -signal.SIGKILL):
        return "no status of an interrupt or of an end"
    if status != 0:
        return "differences that are none" if "differ" in out else ""
    expected: Mapping[str, Callable[[], bool]] = {
        "bag": lambda: _frames(folder / "out.rrd") == SCANS,
        "report": lambda: (folder / "bug.html").exists() and _frames(folder / "bug.rrd") == SCANS,
        "report --check": lambda: f"{SCANS} frames: the same in every bit" in out,
        "batch": lambda: _frames(folder / "runs" / "drive.rrd") == SCANS,
    }
    return "" if expected[command]() else "and not all frames"


def _frames(path: Path) -> int:
    from tests.recordings import Recording

    return len(Recording(path).rows["/bev"]) if path.exists() else 0


def _unreadable(path: Path) -> str:
    from rerun.chunk import RrdReader

    if not path.stat().st_size:
        return ""  # killed before anything was written
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for _ in RrdReader(path).stream():
                pass
    except (RuntimeError, ValueError) as error:
        return str(error).splitlines()[0]
    return ""


def _start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    kept = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    return subprocess.Popen(
        [sys.executable, "-m", "bevviz", *arguments],
        cwd=folder,
        env={**kept, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _finish(folder: Path, *arguments: str) -> None:
    """Raises RuntimeError where an undisturbed command does not end well."""
    process = _start(folder, *arguments)
    try:
        _, said = process.communicate(timeout=LIMIT)
    finally:
        process.kill()
    if process.returncode != 0:
        last = said.strip().splitlines()[-1:] or ["nothing"]
        raise RuntimeError(f"'bevviz {' '.join(arguments)}' ends with {process.returncode}: {last[0]}")
