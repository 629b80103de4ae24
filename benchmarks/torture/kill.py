"""Processes that are interrupted, terminated, hung up and killed at any time, from the first instant on."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from tqdm import tqdm

from bevviz.support.files import unfinished_files
from tests.support import bags, replay

SCANS = 40
SHORT = (10, 3, 6)  # scans of each of a batch's bags
LIMIT = 120.0  # seconds for a command, undisturbed or after its signal
PATIENCE = 20.0  # seconds that what a command has started may outlive it
GONE_ON = 3  # killed runs of each command that are run again
ROOT = Path(__file__).resolve().parents[2]
OURS = f"{ROOT / 'bevviz'}{os.sep}"  # a traceback without a line of ours is one of Python's own start
ADDRESS = "BEVVIZ_TORTURE_SCHEDULER"  # of the Dask cluster, in the environment
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)


PROGRAM = ("-m", "bevviz")


@dataclass(frozen=True)
class Command:
    """A command, and what must be true of what it made where it ends with status 0."""

    arguments: tuple[str, ...]
    true: Callable[[Path, str], bool]  # of the folder and what was printed
    made: tuple[str, ...] = ()  # removed before each run
    endless: float = 0.0  # seconds until it has begun all that it does until it is ended
    program: tuple[str, ...] = PROGRAM


def _saved(name: str, entity: str = "/bev") -> Callable[[Path, str], bool]:
    return lambda folder, out: _frames(folder / name, entity) == SCANS


def _batch_is_whole(folder: Path, out: str) -> bool:
    whole = [_frames(folder / "runs" / f"{i}.rrd") for i in range(len(SHORT))]
    return whole == list(SHORT) and (folder / "runs" / "summary.html").exists()


BATCH = ("batch", "bags", "-o", "runs")
COMMANDS: dict[str, Command] = {
    "bag": Command(("bag", "drive", "--save", "out.rrd"), _saved("out.rrd"), ("out.rrd",)),
    "info": Command(("info", "drive"), lambda _, out: "161 messages" in out),
    "why": Command(("why", "drive", "--at", "2"), lambda _, out: out.startswith("frame 20,")),
    "report": Command(
        ("report", "drive", "--at", "2", "-o", "bug.rrd", "--force"),
        lambda folder, out: (folder / "bug.html").exists() and _saved("bug.rrd")(folder, out),
        ("bug.rrd", "bug.html", "bug.mcap"),
    ),
    "report --check": Command(
        ("report", "--check", "checked.rrd"), lambda _, out: f"{SCANS} frames: the same in every bit" in out
    ),
    "compare": Command(
        ("compare", "drive", "--set-b", "voxel.size=0.3", "--save", "c.rrd", "--csv", "c.csv"),
        lambda folder, out: (folder / "c.csv").exists() and _saved("c.rrd")(folder, out),
        ("c.rrd", "c.csv"),
    ),
    "sweep": Command(
        ("sweep", "drive", "--set", "voxel.size=0.2,0.3", "--csv", "s.csv"),
        lambda folder, out: len((folder / "s.csv").read_text().splitlines()) == 3,
        ("s.csv",),
    ),
    "calib": Command(
        ("calib", "drive", "--write", "c.yaml"), lambda folder, _: (folder / "c.yaml").exists(), ("c.yaml",)
    ),
    "demo --bag": Command(
        ("demo", "--frames", "20", "-o", "demo.mcap"),
        lambda folder, out: (folder / "demo.mcap").exists(),
        ("demo.mcap",),
    ),
    "batch": Command((*BATCH, "--jobs", "2"), _batch_is_whole, ("runs",)),
    "batch --dask": Command((*BATCH, "--dask", ADDRESS), _batch_is_whole, ("runs",)),
    "live": Command(
        ("live", "--save", "l.rrd"), lambda *_: True, ("l.rrd",), endless=8, program=(replay.__file__, "10")
    ),
    "open": Command(("open", "drive", "--no-browser"), lambda *_: True, endless=6),
}


@dataclass
class Killed:
    """Result of the signals that a command was sent."""

    signals: int = 0
    ended: int = 0  # before the signal came
    python: int = 0  # tracebacks of Python's own start, before the first module of ours
    tracebacks: int = 0  # of ours
    false: int = 0  # a status or a result that is not true
    hangs: int = 0
    unreadable: int = 0  # files under the name of a whole one, or of an unfinished one
    left: int = 0  # runs that left processes, or files of which nobody knows
    lost: int = 0  # the same command, run again, does not end well, or does again what was complete
    gone_on: int = 0  # killed runs that were run again
    slowest: float = 0.0  # seconds from an interrupt to the end
    examples: list[str] = field(default_factory=list)

    @property
    def well(self) -> bool:
        return not any((self.tracebacks, self.false, self.hangs, self.unreadable, self.left, self.lost))


HEAD = """| command | signals | not running | Python's start | tracebacks | false | hangs | unreadable | \
left | lost | s to the end |
| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"""


def row(name: str, k: Killed) -> str:
    return (
        f"| {name} | {k.signals} | {k.ended} | {k.python} | {k.tracebacks} | {k.false} | {k.hangs} "
        f"| {k.unreadable} | {k.left} | {k.lost} | {k.slowest:.1f} |"
    )


def run(seed: int, count: int, names: Sequence[str] = tuple(COMMANDS)) -> Iterator[tuple[str, Killed]]:
    """Send each of the commands its share of ``count`` signals. The inputs are made once."""
    rng = random.Random(seed)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        bags.write(folder / "drive", bags.small_items(scans=SCANS))
        for number, scans in enumerate(SHORT):
            bags.write(folder / "bags" / str(number), bags.small_items(scans=scans))
        if "report --check" in names:
            _finish(folder, "report", "drive", "--at", "2", "-o", "checked.rrd")
        if "batch --dask" in names:
            os.environ[ADDRESS] = stack.enter_context(_cluster())
        bar = stack.enter_context(tqdm(total=count, unit="signal", desc="kill", disable=None))
        for number, name in enumerate(names):
            tally = Killed()
            duration = COMMANDS[name].endless or _duration(folder, name)
            for _ in range(count // len(names) + (number < count % len(names))):
                # Half of them in the first half second, where everything is imported.
                latest = 0.5 if rng.random() < 0.5 else 1.1 * duration
                everyone = rng.random() < 0.5  # as a terminal sends them
                _one(folder, name, rng.choice(SIGNALS), rng.uniform(0, latest), everyone, tally)
                bar.update()
            yield name, tally


def _duration(folder: Path, name: str) -> float:
    _clean(folder, name)
    began = time.monotonic()
    _finish(folder, *COMMANDS[name].arguments)
    return time.monotonic() - began


def _one(
    folder: Path, name: str, number: signal.Signals, delay: float, everyone: bool, tally: Killed
) -> None:
    command = COMMANDS[name]
    _clean(folder, name)
    before = _files(folder)
    process = _start(folder, *command.arguments, program=command.program)
    time.sleep(delay)
    everyone = everyone and number != signal.SIGKILL
    what = f"{name}, {number.name}{' to all' if everyone else ''} after {delay:.3f} s"
    tally.signals += 1
    sent = time.monotonic()
    if process.poll() is not None:
        tally.ended += 1
    elif everyone:
        os.killpg(process.pid, number)
    else:
        process.send_signal(number)
    try:
        out, said = process.communicate(timeout=LIMIT)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        tally.hangs += 1
        tally.examples.append(f"{what}: hangs")
        return
    killed = number == signal.SIGKILL
    if not killed:
        tally.slowest = max(tally.slowest, time.monotonic() - sent)
    # What a killed process has started may say that it has gone.
    if not killed and ("Traceback" in said or "Fatal Python error" in said or "Exception ignored" in said):
        if OURS in said:
            tally.tracebacks += 1
            tally.examples.append(f"{what}: {said.strip()[-1500:]}")
        else:
            tally.python += 1
            return
    if problem := _falsehood(folder, command, process.returncode, out):
        tally.false += 1
        tally.examples.append(f"{what}: status {process.returncode}, {problem}")
    for path in [*folder.glob("*.rrd"), *folder.glob("runs/*.rrd")]:
        if problem := _unreadable(path):
            tally.unreadable += 1
            tally.examples.append(f"{what}: {path.name}: {problem}")
    if problem := _left(folder, process.pid, before, command.made, killed):
        tally.left += 1
        tally.examples.append(f"{what}: {problem}")
    if not command.endless and (name.startswith("batch") or (killed and tally.gone_on < GONE_ON)):
        tally.gone_on += killed
        if problem := _goes_on(folder, command):
            tally.lost += 1
            tally.examples.append(f"{what}: then {problem}")


def _falsehood(folder: Path, command: Command, status: int, out: str) -> str:
    """Return what is wrong with an exit status and the output that it vouches for, or an empty text."""
    if status not in (0, 130, *(-number for number in SIGNALS)) and not (command.endless and status == 1):
        return "no status of an interrupt or of an end"
    if status != 0:
        return "differences that are none" if " frames differ, first" in out else ""
    return "" if command.true(folder, out) else "and not all that it should be"


def _goes_on(folder: Path, command: Command) -> str:
    """Run again, it ends well, and what was complete is left as it is."""
    complete = {table: table.stat().st_mtime_ns for table in folder.glob("runs/[0-9].parquet")}
    try:
        out = _finish(folder, *command.arguments)
    except RuntimeError as error:
        return str(error)
    if any(table.stat().st_mtime_ns != time_ for table, time_ in complete.items()):
        return "what was complete is made anew"
    return "" if command.true(folder, out) else "not all is there"


def _left(folder: Path, session: int, before: set[str], made: Sequence[str], killed: bool) -> str:
    """Return the processes or the unexpected files that the command left behind; empty if there are none."""
    deadline = time.monotonic() + PATIENCE
    while (running := _session(session)) and time.monotonic() < deadline:
        time.sleep(0.05)
    if running:
        with suppress(ProcessLookupError):
            os.killpg(session, signal.SIGKILL)
        return f"still running: {'; '.join(running)}"
    expected = {*made, *(path.name for name in made for path in unfinished_files(folder / name))}
    files = {name for name in _files(folder) - before if name.split("/")[0] not in expected}
    if killed:  # the next one removes it
        files = {name for name in files if not name.startswith("tmp/")}
    else:
        files |= {name for name in _files(folder) if name.startswith("runs/.")}
    return f"left: {', '.join(sorted(files))}" if files else ""


def _session(number: int) -> list[str]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _, _, session = stat.read_text().rpartition(")")[2].split()[:4]
            if int(session) == number and state != "Z":
                command = stat.with_name("cmdline").read_bytes().replace(b"\0", b" ")
                found.append(command.decode(errors="replace")[:200])
    return found


def _files(folder: Path) -> set[str]:
    """Relative names; the temporary folder is within."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def _frames(path: Path, entity: str = "/bev") -> int:
    from tests.support.recordings import Recording

    return len(Recording(path).rows[entity]) if path.exists() else 0


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


@contextmanager
def _cluster() -> Iterator[str]:
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as started:
        yield started.scheduler_address


def _clean(folder: Path, name: str) -> None:
    for made in COMMANDS[name].made:
        for path in (folder / made, *unfinished_files(folder / made)):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def _start(folder: Path, *arguments: str, program: Sequence[str] = PROGRAM) -> subprocess.Popen[str]:
    kept = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    temporary = folder / "tmp"
    temporary.mkdir(exist_ok=True)
    given = [os.environ.get(a, a) for a in arguments]
    return subprocess.Popen(
        [sys.executable, *program, *given],
        cwd=folder,
        env={**kept, "PYTHONPATH": str(ROOT), "TMPDIR": str(temporary), "XDG_RUNTIME_DIR": str(temporary)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=_undeafened,
    )


def _undeafened() -> None:
    """Restore the handling of Ctrl-C. A shell starts background processes with SIGINT ignored."""
    for number in SIGNALS[:3]:
        signal.signal(number, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)


def _finish(folder: Path, *arguments: str) -> str:
    """Return the output of an undisturbed command. Raise RuntimeError if the command fails."""
    process = _start(folder, *arguments)
    try:
        out, said = process.communicate(timeout=LIMIT)
    finally:
        process.kill()
    if process.returncode != 0:
        last = said.strip().splitlines()[-1:] or ["nothing"]
        raise RuntimeError(f"'bevviz {' '.join(arguments)}' ends with {process.returncode}: {last[0]}")
    return out
