"""Processor time for each frame of every command, as a ratio to ``bevviz bag`` on the same drive.

Each command runs in a process of its own, on the whole drive and on its first frames, and the commands
take turns. The difference is the time of the further frames; the rest of the shorter run is the start.
``compare`` and ``sweep`` count for each configuration, and ``why`` for each frame whose objects it
explains. ``open`` runs without a page that draws.

Detections come from a store that a run before has filled, unless ``--network`` is stated: the network takes
the same time in all commands, and would hide what else they do.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from tqdm import tqdm

from benchmarks import bags
from benchmarks.measure import children_time, machine

FRAMES = 60  # of the synthetic drive
FEW = 10  # of the shorter run
ALLOWED = 1.3  # times the processor time of ``bag``
VALUES = 3  # of the sweep


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--drive", type=Path, help="a bag or a data set's folder, else a simulated drive")
    parser.add_argument("--model", default="demo", help="detector (default: demo)")
    parser.add_argument("--repetitions", type=int, default=5, metavar="N", help="of each run (default: 5)")
    parser.add_argument("--only", default="", metavar="NAMES", help="commands, with commas between")
    parser.add_argument("--network", action="store_true", help="run the network in each command")
    parser.add_argument("--inside", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.inside:
        name, bag = options.inside
        {"why": _why, "open": _open}[name](Path(bag), options.model)
        return 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        drive = options.drive or bags.simulate(FRAMES, folder / "drive.mcap")
        drives = {"whole": drive, "few": _cut(drive, folder / "few.mcap")}
        table = _table(drives, options, folder)
    print(machine(), "", *table, sep="\n")
    return 0


def _cut(drive: Path, path: Path) -> Path:
    """Write the first frames of a drive as a bag."""
    from bevviz.bags.source import BagSource
    from bevviz.config import load
    from bevviz.report.bag_window import choose_topics, cut_bag, find_window

    with BagSource([drive], load()) as source:
        scans = source.scans
        window = find_window(source, int(scans[0]), 0, float(scans[FEW - 1] - scans[0]) * 1e-9)
        cut_bag(source.recording, window, choose_topics(source.recording, source.roles, None), [], path)
    return path


def _scans(bag: Path) -> int:
    from bevviz.bags.source import BagSource
    from bevviz.config import load

    with BagSource([bag], load()) as source:
        return len(source.scans)


def _commands(folder: Path, model: str) -> dict[str, tuple[int, Callable[[Path], list[str]]]]:
    """Return how often each command runs the stages on a frame, and its command line for a bag."""
    bevviz, network = [sys.executable, "-m", "bevviz"], ["--model", model]
    inside = [sys.executable, "-m", "benchmarks.commands", "--model", model, "--inside"]
    sweep = f"clustering.eps=0.4:{0.4 + 0.1 * (VALUES - 1):.1f}:0.1"

    def command(name: str, *more: str, model: Sequence[str] = network) -> Callable[[Path], list[str]]:
        return lambda bag: [*bevviz, name, str(bag), *model, *more]

    saved = str(folder / "saved.rrd")
    whole = ("--at", "0", "--before", "0", "--after", "100000")
    return {
        "bag": (1, command("bag", "--save", saved)),
        "evaluate": (1, command("evaluate")),
        "compare": (2, command("compare", "--set-b", "clustering.eps=0.8")),
        "sweep": (VALUES, command("sweep", "--set", sweep)),
        "report": (1, command("report", *whole, "-o", str(folder / "report.rrd"), "--force")),
        "export": (1, command("export", "-o", str(folder / "export"))),
        "batch": (1, command("batch", "-o", str(folder / "batch"), "--force", "--jobs", "1")),
        "calib": (1, command("calib", "--every", "1", model=())),
        "info --sensors": (1, command("info", "--sensors", model=())),
        "why": (1, lambda bag: [*inside, "why", str(bag)]),
        "open": (1, lambda bag: [*inside, "open", str(bag)]),
    }


def _table(drives: dict[str, Path], options: argparse.Namespace, folder: Path) -> list[str]:
    """Run the commands in turns and return the rows."""
    commands = _commands(folder, options.model)
    names = ["bag", *(n for n in options.only.split(",") if n)] if options.only else list(commands)
    store = "" if options.network else str(folder / "store")
    times: dict[tuple[str, str], list[float]] = {}
    for repetition in tqdm(range(-1, options.repetitions), unit="round", disable=None):
        for name in names:
            for size, drive in drives.items():
                seconds = _processor_time(commands[name][1](drive), store, folder)
                if repetition >= 0:  # The first round compiles, and fills the store.
                    times.setdefault((name, size), []).append(seconds)
    scans = {size: _scans(drive) for size, drive in drives.items()}
    further = scans["whole"] - scans["few"]

    def frame_times(name: str) -> list[float]:
        runs = commands[name][0]
        pairs = zip(times[name, "whole"], times[name, "few"], strict=True)
        return [(whole - few) / further / runs for whole, few in pairs]

    rows = ["| command | ms a frame | of `bag` | start, s |", "| --- | ---: | ---: | ---: |"]
    bag = frame_times("bag")
    for name in names:
        each = frame_times(name)
        ratio = median(each) / median(bag)
        start = median(times[name, "few"]) - scans["few"] * median(each) * commands[name][0]
        over = " (too slow)" if ratio > ALLOWED else ""
        rows.append(f"| `{name}` | {1e3 * median(each):.0f} | {ratio:.2f}{over} | {start:.1f} |")
    return rows


def _processor_time(command: list[str], store: str, folder: Path) -> float:
    """Return the seconds of processor time of a command, of all its processes.

    Raises:
        SystemExit: it failed.
    """
    for made in ("export", "batch"):
        shutil.rmtree(folder / made, ignore_errors=True)
    before = children_time()
    variables = {"BEVVIZ_STORE": store, "OPENBLAS_NUM_THREADS": "1"}  # as the command line sets it
    done = subprocess.run(
        command, env={**os.environ, **variables}, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: {done.stderr[-2000:]}")
    return children_time() - before


# --- commands that answer for single frames, or do not end by themselves -------------------------


def _why(bag: Path, model: str) -> None:
    """Explain the objects of each frame, as ``bevviz why --at-frame N`` does."""
    import bevviz

    drive = bevviz.open(bag, model=model)
    for number in range(len(drive)):
        drive.why(frame=number)


def _open(bag: Path, model: str) -> None:
    """Run a drive as its page does, and read its progress until it is over."""
    import time

    import bevviz
    from bevviz.bags.source import BagSource
    from bevviz.config import load
    from bevviz.workbench.session import recorded_session

    config = load(None, [f"detector.model={model}"])
    source, again = BagSource([bag], config), BagSource([bag], config)
    session = recorded_session(bevviz.Drive(source, config), again, [bag])
    drive: Any = session.source
    drive.start()
    drive.go_on()
    while not drive.over:
        time.sleep(0.05)
    progress = drive.progress()
    drive.close()
    if progress["error"]:
        raise SystemExit(json.dumps(progress))


if __name__ == "__main__":
    sys.exit(main())
