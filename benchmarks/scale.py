"""How one drive scales over processes: measured where there are cores, else by its serial part.

``bevviz bag --jobs 1, 2, 4 ...`` and Rerun's own converter take turns on the synthetic drive; of each run the
wall time and the processor time of all its processes are told. The serial part (Amdahl 1967) is told from
processor times in one process: what cutting into windows and the ordered pass take of a frame, against all.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import median

from tqdm import tqdm

from benchmarks import bags
from benchmarks.measure import machine, run
from bevviz.bags.source import BagSource
from bevviz.config import load
from bevviz.drive import Drive
from bevviz.engine.task import JobResults, Task
from bevviz.logging.recorder import OrderedRecorder
from bevviz.logging.sinks import open_recording
from bevviz.parallel.run import run_windows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scans", type=int, default=200, help="of the drive (default: 200)")
    parser.add_argument("--repetitions", type=int, default=3, metavar="N", help="of each run (default: 3)")
    parser.add_argument("--bag", type=Path, help="a drive that is there, instead")
    parser.add_argument("--serial-only", action="store_true", help="the serial part alone")
    options = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    print(machine())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        bag = options.bag or bags.simulate(options.scans, folder / "drive.mcap")
        with BagSource([bag], load()) as source:
            scans = source.total
        if not options.serial_only:
            print(*_measured(bag, folder, cores, options.repetitions), sep="\n")
        print(*_fitted(bag, folder, scans), sep="\n")


def _measured(bag: Path, folder: Path, cores: int, repetitions: int) -> list[str]:
    """Rows of the table of whole runs."""
    counts = [1, 2] + [n for n in (4, 8, 16, 32, 64) if n <= cores]
    saved = folder / "saved.rrd"
    commands: dict[str, tuple[str, ...]] = {
        f"--jobs {n}": ("bevviz", "bag", str(bag), "--model", "demo", "--jobs", str(n), "--save", str(saved))
        for n in counts
    }
    commands["rerun mcap convert"] = ("rerun", "mcap", "convert", str(bag), "-o", str(folder / "theirs.rrd"))
    run(*commands["--jobs 1"])  # so that nothing is compiled meanwhile
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in commands}
    for _ in tqdm(range(repetitions), unit="run", disable=None):
        for name, command in commands.items():
            before = _processor(resource.RUSAGE_CHILDREN)
            wall = run(*command).seconds
            seconds[name].append((wall, _processor(resource.RUSAGE_CHILDREN) - before))
    rows = ["| run | wall s | processor s | of --jobs 1 |", "| --- | ---: | ---: | ---: |"]
    one = median(wall for wall, _ in seconds["--jobs 1"])
    for name, found in seconds.items():
        wall, busy = (median(column) for column in zip(*found, strict=True))
        rows.append(f"| {name} | {wall:.2f} | {busy:.2f} | {one / wall:.2f} x |")
    return rows


def _fitted(bag: Path, folder: Path, scans: int) -> list[str]:
    """Processor time of a frame, by who spends it, and what follows from that."""
    engine = _Here()
    config = load(None, ["detector.model=demo"])
    with Drive(BagSource([bag], config), config) as warm:
        next(iter(warm))
    with Drive(BagSource([bag], config), config) as drive:
        start = time.process_time()
        with open_recording(drive.scene, config, save=folder / "fitted.rrd", in_parts=True) as sinks:
            seen = [OrderedRecorder(sinks.recording, config)]
            run_windows(drive, drive.new_session(), sinks, seen, engine)
        total = time.process_time() - start
    serial = total - engine.seconds
    share = serial / total
    reach = ", ".join(f"{n}: {1 / (share + (1 - share) / n):.1f} x" for n in (2, 4, 8, 16))
    return [
        f"processor time of a frame {1e3 * total / scans:.1f} ms, "
        f"of which in order {1e3 * serial / scans:.1f} ms ({100 * share:.0f} %)",
        f"speed-up that this allows, by processes: {reach}",
    ]


class _Here:
    """Runs windows in this process, and counts what they take of its time."""

    count = 2

    def __init__(self) -> None:
        self.seconds = 0.0

    def close(self) -> None: ...

    def run(
        self,
        jobs: Iterable[Task],
        retries: int,
        on_frame: Callable[[], None],
        tick: Callable[[], None] = lambda: None,
    ) -> JobResults:
        for job in list(jobs):  # cut before: it has threads of its own
            start = time.process_time()
            result = job.run(1, on_frame)
            self.seconds += time.process_time() - start
            yield result


def _processor(who: int) -> float:
    used = resource.getrusage(who)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
