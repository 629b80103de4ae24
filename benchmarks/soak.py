"""Endurance of the live runtime: the synthetic drive at full size in real time, the whole pipeline beside it.

The drive is rendered beforehand. Prints rates, latencies from arrival to logged, drops, CPU and memory, and a
summary; ends with status 1 where the p99 is above the time between two scans, or where memory grows.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from tqdm import tqdm

from bevviz.config.reloading import ReloadableConfig
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.live.run_outputs import Outputs
from bevviz.live.runtime import Live, Status
from bevviz.live.status import Notes
from tests.support.replay import Replay

WARM = 10.0  # seconds at the start that are left out: kernels are loaded, buffers fill
GROWTH = 1.1  # memory at the end to memory when the flight recorder was full


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=1.0, help="how long (default: 1)")
    parser.add_argument("--rate", type=float, default=10.0, help="scans a second (default: 10)")
    parser.add_argument("--frames", type=int, default=30, help="scans rendered, played forth and back")
    parser.add_argument("--model", default=_default_model(), help="detector (default: yolox_nano)")
    parser.add_argument("--serve", type=int, metavar="PORT", help="with a web viewer")
    parser.add_argument(
        "--save", action="store_true", help="save everything too, in parts that are then removed"
    )
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as for bevviz live")
    options = parser.parse_args()

    simulated = SyntheticSource(frames=options.frames)
    drive = list(tqdm(simulated, total=simulated.total, unit="scan", desc="simulate", disable=None))
    total = round(60 * options.minutes * options.rate)
    source = Replay(drive, simulated.scene, rate=options.rate, total=total)
    split = "live.split_size=500 MB"
    settings = ReloadableConfig(settings=[f"detector.model={options.model}", split, *options.set])
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}")
    size = f"{simulated.intrinsics.width} x {simulated.intrinsics.height}"
    print(f"{len(drive[0].points)} points and a {size} image at {options.rate:g} Hz")
    with tempfile.TemporaryDirectory() as folder:
        save = Path(folder, "soak.rrd") if options.save else None
        live = Live(source, settings, Outputs(save=save, serve=options.serve), Notes(print))
        soak = Soak(live)
        live.run(soak.look)
    return soak.summary(1 / options.rate)


class Soak:
    """Collects what a run says of itself, and prints a line every ten seconds."""

    def __init__(self, live: Live) -> None:
        self._live = live
        self._start = self._printed = time.monotonic()
        self._looks: list[tuple[float, Status]] = []
        self._before = np.zeros_like(live.health.histogram)  # latencies of the warm-up
        print("|    s | frames/s | p50, ms | p99, ms | dropped | CPU, % of a core | memory, MB |")
        print("| ---: | -------: | ------: | ------: | ------: | ---------------: | ---------: |")

    def look(self, status: Status) -> None:
        now = time.monotonic()
        if now - self._start < WARM:
            self._before = self._live.health.histogram.copy()
            return
        self._looks.append((now - self._start, status))
        if now - self._printed >= 10:
            self._printed = now
            self._line(self._looks[-11:])

    def _line(self, looks: list[tuple[float, Status]]) -> None:
        (before, first), (now, last) = looks[0], looks[-1]
        rate = (last.frames - first.frames) / max(now - before, 1e-9)
        cpu = np.mean([status.cpu for _, status in looks])
        print(
            f"| {now:4.0f} | {rate:8.2f} | {1e3 * last.p50:7.0f} | {1e3 * last.p99:7.0f} "
            f"| {sum(last.drops.values()):7d} | {cpu:16.0f} | {last.memory:10.0f} |",
            flush=True,
        )

    def summary(self, period: float) -> int:
        """Of the run without its warm-up. Returns 1 where a limit is broken."""
        if not self._looks:
            print("too short: nothing is left after the warm-up")
            return 1
        share = np.cumsum(self._live.health.histogram - self._before)
        p50, p90, p99 = (int(np.searchsorted(share, q * share[-1])) + 1 for q in (0.5, 0.9, 0.99))
        memory = np.array([status.memory for _, status in self._looks])
        filled = self._live.config.live.flight_time + WARM
        full = np.array([now > filled for now, _ in self._looks])
        growth = memory[full][-10:].mean() / memory[full][:10].mean() if full.sum() >= 20 else float("nan")
        (before, first), (now, last) = self._looks[0], self._looks[-1]
        drops = {place: count - first.drops.get(place, 0) for place, count in last.drops.items()}
        print(f"\n{last.frames - first.frames} frames in {now - before:.0f} s, dropped: {drops}")
        print(f"arrival to logged: p50 {p50} ms, p90 {p90} ms, p99 {p99} ms; period {1e3 * period:.0f} ms")
        print(f"memory: most {memory.max():.0f} MB, at the end {growth:.3f} of when the recorder was full")
        return int(p99 > 1e3 * period or growth > GROWTH)


def _default_model() -> str:
    model = Path(__file__).resolve().parents[2] / "shared/data/models/yolox_nano.onnx"
    return str(model) if model.exists() else "demo"


if __name__ == "__main__":
    sys.exit(main())
