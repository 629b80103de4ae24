"""A recording that is larger than memory, in Rerun's own viewer with a limit to its memory.

Makes a recording of so many gigabytes (the synthetic drive over and over, logged as `bevviz bag` logs), opens
it without a window, goes through it to its end, and says when the first picture was there and how much memory
the viewer took. Needs Vulkan, if only in software (mesa-vulkan-drivers). Prints a section of
benchmarks/RESULTS.md.
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from rerun.experimental import ViewerClient
from tqdm import tqdm

import bevviz
from benchmarks.measure import machine, peak_memory
from benchmarks.pages import write_section
from bevviz.model.results import FrameResult
from bevviz.recording import entities, rerun_cli
from bevviz.recording.frame_logger import FrameLogger
from bevviz.recording.ports import LOOPBACK, free_port, is_listening
from bevviz.recording.sinks import open_recording
from bevviz.recording.writer import SCALAR_WAIT

LOOKS = 6  # pictures at most, of which the last is taken: on a busy machine plots go on to move
PERIOD = 100_000_000  # nanoseconds from one frame to the next


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=float, default=10.5, help="GB of the recording (default: 10.5)")
    parser.add_argument("--limit", default="2GB", help="of the viewer's memory (default: 2GB)")
    parser.add_argument("--stops", type=int, default=40, help="times that are gone to (default: 40)")
    parser.add_argument("--recording", type=Path, help="one that is there; default: it is made, and removed")
    parser.add_argument("--folder", type=Path, help="where it is made; default: that of temporary files")
    parser.add_argument("--pictures", type=Path, help="folder for screenshots of the first and the last stop")
    parser.add_argument("--write", type=Path, help="page whose section is replaced, instead of printing")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as name:
        recording = options.recording or make(Path(name) / "large.rrd", options.size)
        row = opened(recording, options.limit, options.stops, options.pictures)
    section = "\n".join(
        [
            "## Larger than memory",
            "",
            f"`python -m benchmarks.large`, {datetime.now(UTC):%Y-%m-%d}: {machine()}, drawn in software at",
            "1920 x 1080. Memory is the peak of the viewer's process.",
            "",
            "| recording | limit | first picture | a further time: median, most | memory at first, most |",
            "| --- | ---: | ---: | ---: | ---: |",
            row,
        ]
    )
    if options.write:
        write_section(options.write, section)
    else:
        print(section)


def make(path: Path, size: float, frames: int = 50) -> Path:
    """Write a recording of at least ``size`` GB."""
    with bevviz.simulate(frames, set=["detector.model=demo"]) as drive:
        results = [without_what_is_not_logged(result) for result in drive]
        config, scene = drive.config, drive.scene
    with (
        open_recording(scene, config, save=path) as sinks,
        tqdm(total=round(size * 1e3), unit="MB", desc="make", disable=None) as bar,
    ):
        assert sinks.file is not None
        logger = FrameLogger(sinks.recording, config, scene, wait=SCALAR_WAIT)
        logger.log_static()
        count = 0
        while sinks.file.stat().st_size < size * 1e9:
            for result in results:
                logger.log(later(result, count))
                count += 1
            bar.update(round(sinks.file.stat().st_size / 1e6) - bar.n)
        logger.close()
    return path


def without_what_is_not_logged(result: FrameResult) -> FrameResult:
    return replace(result, frame=replace(result.frame, fields={}))


def later(result: FrameResult, index: int) -> FrameResult:
    """Return the frame's result as that of frame ``index``, with stamps to match."""
    by = (index - result.frame.index) * PERIOD
    cameras = tuple(
        replace(
            one,
            camera=replace(one.camera, image=replace(one.camera.image, stamp=one.camera.image.stamp + by)),
        )
        if one.camera.image is not None
        else one
        for one in result.cameras
    )
    frame = replace(
        result.frame,
        index=index,
        stamp=result.frame.stamp + by,
        received=result.frame.received + by if result.frame.received else 0,
        cameras=tuple(one.camera for one in cameras),
    )
    return replace(result, frame=frame, cameras=cameras)


# --- the viewer --------------------------------------------------------------------------------


@dataclass
class Watched:
    """A viewer without a window."""

    client: ViewerClient
    process: subprocess.Popen[bytes]

    @property
    def peak(self) -> float:
        """MB that it had at most."""
        return peak_memory(self.process.pid)


@contextmanager
def viewer(recording: Path, limit: str) -> Iterator[Watched]:
    port = free_port(9950)
    arguments = [
        str(recording),
        "--headless",
        "--bind",
        LOOPBACK,
        "--port",
        str(port),
        "--memory-limit",
        limit,
    ]
    process = subprocess.Popen(
        [rerun_cli.rerun_program(), *arguments, "--hide-welcome-screen"],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=rerun_cli.environment(),
    )
    try:
        while not is_listening(LOOPBACK, port):
            if process.poll() is not None:
                raise SystemExit("the viewer does not start: apt-get install mesa-vulkan-drivers")
            time.sleep(0.05)
        yield Watched(ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy"), process)
    finally:
        rerun_cli.stop(process)


def opened(recording: Path, limit: str, stops: int, pictures: Path | None) -> str:
    """Open the recording in the viewer and return a row of the table."""
    begun = time.perf_counter()
    with viewer(recording, limit) as watched:
        client = watched.client
        span = None
        while span is None:
            with suppress(TimeoutError, RuntimeError):
                for shown in client.get_state().recordings:
                    for timeline in shown.timelines:
                        low, high = timeline.start, timeline.end
                        if timeline.name == entities.FRAME and low is not None and high is not None:
                            span = low, high
        picture(watched, span[0], pictures and pictures / "first.png")
        first, at_first = time.perf_counter() - begun, watched.peak
        times = []
        for frame in tqdm(np.linspace(*span, stops).astype(int).tolist(), unit="stop", disable=None):
            start = time.perf_counter()
            picture(watched, frame, pictures / "last.png" if pictures and frame == span[1] else None)
            times.append(time.perf_counter() - start)
        last = [s.current_time for s in client.get_state().recordings]
        if last != [span[1]]:
            raise SystemExit(f"it is at {last}, not at its end {span[1]}")
        most = watched.peak
    size = recording.stat().st_size / 1e9
    return (
        f"| {size:.1f} GB, {span[1] - span[0] + 1} frames | {limit} | {first:.1f} s "
        f"| {np.median(times):.1f} s, {max(times):.1f} s | {at_first / 1e3:.2f} GB, {most / 1e3:.2f} GB |"
    )


def picture(watched: Watched, frame: int, path: Path | None) -> None:
    """Go to a frame and wait until all that is shown of it is there."""
    client = watched.client
    with suppress(TimeoutError):
        client.set_time(entities.FRAME, sequence=frame, play_state="paused")
    before = b""
    for _ in range(LOOKS):  # chunks come one after the other: until nothing changes any more
        try:
            now = client.take_screenshot()
        except (TimeoutError, RuntimeError):
            continue
        if now == before:
            break
        before = now
    if path is not None:
        path.write_bytes(before)


if __name__ == "__main__":
    main()
