"""Endurance of the live runtime: the synthetic drive at full size in real time, the whole pipeline beside it.

The drive is rendered beforehand. ``--dds`` has another process publish it (``benchmarks.robot``), with the
transport profile of the docs. Prints latencies from arrival to logged, rates, drops, CPU and memory of each
minute, and a summary; ends with status 1 where the p99 is above the time between two scans, or where memory
grows.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line sets it, before NumPy is loaded

import numpy as np
from tqdm import tqdm

from benchmarks.measure import default_model, machine
from benchmarks.robot import POSES
from benchmarks.transport import PROFILE
from bevviz.config.reloading import ReloadableConfig
from bevviz.extras.demo.drive import BASE, CAMERA_FRAME, LIDAR_FRAME, MAP, PERIOD, START, SyntheticSource
from bevviz.live.raw_recorder import RawRecorder
from bevviz.live.run_outputs import Outputs
from bevviz.live.runtime import Live
from bevviz.live.source import LiveSource
from bevviz.live.source_wrappers import warm_up
from bevviz.live.status import Notes
from bevviz.model.frame import F64, I64, Frame
from bevviz.model.geometry import quaternion
from bevviz.pipeline.stage_loader import StageLoader
from tests.support.replay import Replay

WARM = 10.0  # seconds at the start that are left out: kernels are loaded, buffers fill
MINUTE = 60.0  # seconds between two lines
GROWTH = 1.1  # memory at the end to memory when the flight recorder was full


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=1.0, help="how long (default: 1)")
    parser.add_argument("--rate", type=float, default=10.0, help="scans a second (default: 10)")
    parser.add_argument("--frames", type=int, default=30, help="scans rendered, played forth and back")
    parser.add_argument(
        "--model", default=str(default_model() or "demo"), help="detector (default: yolox_nano)"
    )
    parser.add_argument("--dds", action="store_true", help="receive the drive from another process")
    parser.add_argument("--profile", type=Path, default=PROFILE, help="the publisher's (default: the docs')")
    parser.add_argument("--domain", type=int, default=47, help="ROS domain that nobody else uses")
    parser.add_argument("--serve", type=int, metavar="PORT", help="with a web viewer")
    parser.add_argument(
        "--save", action="store_true", help="save everything too, in parts that are then removed"
    )
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as for bevviz live")
    options = parser.parse_args()

    simulated = SyntheticSource(frames=options.frames)
    drive = list(tqdm(simulated, total=simulated.total, unit="scan", desc="simulate", disable=None))
    split = "live.split_size=500 MB"
    settings = ReloadableConfig(settings=[f"detector.model={options.model}", split, *options.set])
    print(machine())
    size = f"{simulated.intrinsics.width} x {simulated.intrinsics.height}"
    print(f"{len(drive[0].points)} points and a {size} image at {options.rate:g} Hz")
    notes = Notes(print)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        outputs = Outputs(save=folder / "soak.rrd" if options.save else None, serve=options.serve)
        loader = StageLoader(store=False)  # the drive is repeated, a robot is not
        warm_up(settings.config, loader)
        if options.dds:
            write_drive(folder, simulated, drive)
            os.environ |= {"ROS_DOMAIN_ID": str(options.domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
            profile = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(options.profile)}
            command = [sys.executable, "-m", "benchmarks.robot", str(folder), str(options.rate)]
            publisher = stack.enter_context(subprocess.Popen(command, env=os.environ | profile))
            stack.callback(publisher.terminate)
            raw = RawRecorder(settings)
            robot = stack.enter_context(LiveSource(settings.config, tell=notes.info, raw=raw))
            robot.wait()
            live = Live(robot, settings, outputs, notes, loader=loader)
        else:
            replay = Replay(drive, simulated.scene, rate=options.rate)
            live = Live(replay, settings, outputs, notes, loader=loader)
        soak = Soak(live, WARM + 60 * options.minutes)
        live.run(soak.look)
        print(*live.summary, sep="\n")
        if options.dds:
            print(f"lost by the middleware: {dict(robot.watch.lost) or 'nothing'}")
    return soak.summary(options.rate)


def write_drive(folder: Path, simulated: SyntheticSource, drive: Sequence[Frame]) -> None:
    """Write a drive as ``benchmarks.robot`` reads it."""
    for frame in drive:
        points = np.zeros(
            len(frame.points), [(name, "<f4") for name in ("x", "y", "z", "intensity")] + [("ring", "<u2")]
        )
        for name, values in zip("xyz", frame.points.T, strict=True):
            points[name] = values
        for name in ("intensity", "ring"):
            points[name] = frame.fields[name]
        np.save(folder / f"scan_{frame.index:04}.npy", points)
        image = frame.cameras[0].image
        assert image is not None
        np.save(folder / f"image_{frame.index:04}.npy", image.bgr)
    mounting = [
        (BASE, LIDAR_FRAME, simulated.base_from_lidar),
        (BASE, CAMERA_FRAME, simulated.base_from_camera),
    ]
    about = {
        "lidar": LIDAR_FRAME,
        "camera": CAMERA_FRAME,
        "K": simulated.intrinsics.K.ravel().tolist(),
        "mounting": [_transform(*row) for row in mounting],
    }
    stamps = range(START, START + (len(drive) - 1) * PERIOD + 1, PERIOD // POSES)
    poses = [_transform(MAP, BASE, simulated.map_from_base(stamp)) for stamp in stamps]
    (folder / "camera.json").write_text(json.dumps(about))
    (folder / "poses.json").write_text(json.dumps(poses))


def _transform(parent: str, child: str, pose: F64) -> tuple[str, str, list[float]]:
    return parent, child, [*pose[:3, 3].tolist(), *quaternion(pose).tolist()]


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Numbers of a run at a time."""

    frames: int
    cpu: float  # percent of one core
    memory: float  # MB
    drops: Mapping[str, int]


class Soak:
    """Collects what a run says of itself, and prints a line every minute.

    Args:
        live: the run.
        seconds: seconds after which the run is ended, with its warm-up.
    """

    def __init__(self, live: Live, seconds: float) -> None:
        self._live, self._seconds = live, seconds
        self._start = time.monotonic()
        self._looks: list[tuple[float, Snapshot]] = []
        self._lines = self._row = 0  # lines printed, and looks at the last of them
        self._before = self._at_line = np.zeros_like(live.health.histogram)  # latencies of the warm-up
        print("|  min | p50, ms | p90, ms | p99, ms | most, ms | frames/s | dropped | CPU, % | memory, MB |")
        print("| ---: | ------: | ------: | ------: | -------: | -------: | ------: | -----: | ---------: |")

    def look(self) -> None:
        now = time.monotonic() - self._start
        if now < WARM:
            self._before = self._at_line = self._live.health.histogram.copy()
            return
        live = self._live
        snapshot = Snapshot(live.frames, live.health.cpu, live.health.memory, live.drops)
        self._looks.append((now, snapshot))
        if now - WARM >= MINUTE * (self._lines + 1):
            self._lines += 1
            self._line(self._looks[self._row :])
            self._row = len(self._looks) - 1
            self._at_line = self._live.health.histogram.copy()
        if now >= self._seconds:
            self._live.stop()

    def _line(self, looks: Sequence[tuple[float, Snapshot]]) -> None:
        (before, first), (now, last) = looks[0], looks[-1]
        rate = (last.frames - first.frames) / (now - before)
        dropped = sum(last.drops.values()) - sum(first.drops.values())
        cpu = np.mean([snapshot.cpu for _, snapshot in looks])
        p50, p90, p99, most = self._latencies(self._at_line)
        print(
            f"| {(now - WARM) / 60:4.0f} | {p50:7d} | {p90:7d} | {p99:7d} | {most:8d} | {rate:8.2f} "
            f"| {dropped:7d} | {cpu:6.0f} | {last.memory:10.0f} |",
            flush=True,
        )

    def _latencies(self, before: I64) -> list[int]:
        """Return p50, p90, p99 and the largest latency in ms since a histogram."""
        share = np.cumsum(self._live.health.histogram - before)
        return [int(np.searchsorted(share, q * share[-1])) + 1 for q in (0.5, 0.9, 0.99, 1.0)]

    def summary(self, rate: float) -> int:
        """Of the run without its warm-up. Returns 1 where a limit is broken."""
        if not self._looks:
            print("too short: nothing is left after the warm-up")
            return 1
        p50, p90, p99, most = self._latencies(self._before)
        memory = np.array([snapshot.memory for _, snapshot in self._looks])
        filled = self._live.config.live.flight_time + WARM
        full = np.array([now > filled for now, _ in self._looks])
        growth = memory[full][-10:].mean() / memory[full][:10].mean() if full.sum() >= 20 else float("nan")
        (before, first), (now, last) = self._looks[0], self._looks[-1]
        drops = {place: count - first.drops.get(place, 0) for place, count in last.drops.items()}
        due = rate * (now - before)
        print(f"\n{last.frames - first.frames} frames of {due:.0f} in {now - before:.0f} s, dropped: {drops}")
        print(
            f"arrival to logged: p50 {p50}, p90 {p90}, p99 {p99}, most {most} ms; period {1e3 / rate:.0f} ms"
        )
        print(f"memory: most {memory.max():.0f} MB, at the end {growth:.3f} of when the recorder was full")
        return int(p99 > 1e3 / rate or growth > GROWTH)


if __name__ == "__main__":
    sys.exit(main())
