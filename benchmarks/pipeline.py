"""Speed of the pipeline and size of its recordings, against the tutorial's calls and Rerun's own converter.

Both sides of each ratio process the same frames in this one run. Prints the table of docs/performance.md.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any, TypeVar

import cv2
import numpy as np
from tqdm import tqdm

from benchmarks import tutorial
from bevviz.config import load
from bevviz.frame import Frame
from bevviz.logging.logger import Logger
from bevviz.logging.sinks import open_recording
from bevviz.pipeline import Pipeline
from bevviz.sources.bag import BagSource
from bevviz.sources.messages import decode_cloud
from bevviz.sources.synthetic import SyntheticSource, write_bag

T = TypeVar("T")

STAGES = ("voxel", "ground", "clustering", "projection", "bev", "explain")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=50, help="scans of the synthetic drive (default: 50)")
    parser.add_argument("--model", type=Path, default=_default_model(), help="detector (default: yolox_nano)")
    options = parser.parse_args()
    cv2.setNumThreads(2)

    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}")
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder, "drive.mcap")
        source = SyntheticSource(frames=options.frames)
        write_bag(source, bag, tqdm(source, total=source.total, unit="scan", desc="simulate", disable=None))
        with BagSource([bag], load()) as recorded:
            frames = list(recorded)
        stages(bag, frames)
        recordings(bag, len(frames), options.model)


def stages(bag: Path, frames: list[Frame]) -> None:
    """Milliseconds a frame, stage by stage, of both sides on the same frames."""
    reference = tutorial.Stages()
    theirs: dict[str, list[float]] = {}
    ours: dict[str, list[float]] = {}
    messages = _clouds(bag)
    with Pipeline(load()) as pipeline, tempfile.TemporaryDirectory() as folder:
        pipeline.run(frames[0])  # compiled kernels are loaded here
        reference.clustering(reference.ground(reference.voxel(frames[0].points)))
        with open_recording(_scene(bag), load(), save=Path(folder, "x.rrd"), blueprint="debug") as sinks:
            logger = Logger(sinks.recording, load(), _scene(bag))
            logger.log_static()
            for frame, message in zip(
                tqdm(frames, unit="frame", desc="stages", disable=None), messages, strict=True
            ):
                _timed(ours, "decode", decode_cloud, message, "/points", 0)
                result = pipeline.run(frame)
                for stage in STAGES:
                    ours.setdefault(stage, []).append(result.timings.get(stage, 0.0))
                _timed(ours, "log", logger.log, result)

                points = _timed(theirs, "decode", tutorial.decode, message)
                cloud = _timed(theirs, "voxel", reference.voxel, points)
                obstacles = _timed(theirs, "ground", reference.ground, cloud)
                _timed(theirs, "clustering", reference.clustering, obstacles)
                _timed(theirs, "bev", tutorial.bev, points, 10, 10, 0.05)

    print(f"\n{len(frames)} frames, {median(len(f.points) for f in frames):.0f} points, medians\n")
    print("| stage | tutorial, ms | bevviz `default`, ms | ratio |\n| --- | ---: | ---: | ---: |")
    for stage in ("decode", *STAGES, "log"):
        mine = 1e3 * median(ours[stage])
        if stage in theirs:
            other = 1e3 * median(theirs[stage])
            print(f"| {stage} | {other:.1f} | {mine:.1f} | {other / mine:.1f} |")
        else:
            print(f"| {stage} | | {mine:.1f} | |")
    total_ours = sum(np.median(v) for v in ours.values())
    total_theirs = sum(np.median(v) for v in theirs.values())
    print(
        f"| all | {1e3 * total_theirs:.1f} ({1 / total_theirs:.1f} frames/s) "
        f"| {1e3 * total_ours:.1f} ({1 / total_ours:.1f} frames/s) | {total_theirs / total_ours:.1f} |"
    )


def recordings(bag: Path, frames: int, model: Path | None) -> None:
    """Whole runs, each in a process of its own, against ``rerun mcap convert``."""
    duration = frames / 10
    converted = bag.with_name("converted.rrd")
    runs: list[tuple[str, list[str], Path]] = [
        ("rerun mcap convert", _script("rerun", "mcap", "convert", str(bag), "-o", str(converted)), converted)
    ]
    for name, extra in [
        ("bevviz bag, no network", []),
        (f"bevviz bag, {model.stem}" if model else "", ["--model", str(model)]),
        ("bevviz bag, demo network", ["--model", "demo"]),
    ]:
        if name:
            out = bag.with_name(f"{len(runs)}.rrd")
            runs.append((name, _script("bevviz", "bag", str(bag), "--save", str(out), *extra), out))
    print("\n| bag to .rrd | s | times real time | frames/s | MB | of the converter's size |")
    print("| --- | ---: | ---: | ---: | ---: | ---: |")
    for name, command, out in runs:
        start = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        seconds = time.perf_counter() - start
        size, base = out.stat().st_size, converted.stat().st_size
        print(
            f"| {name} | {seconds:.1f} | {duration / seconds:.2f} | {frames / seconds:.1f} "
            f"| {size / 1e6:.1f} | {size / base:.2f} |"
        )
    print(f"\nthe bag: {duration:.0f} s, {bag.stat().st_size / 1e6:.1f} MB; runs include the process's start")


def _timed(times: dict[str, list[float]], name: str, function: Callable[..., T], *arguments: Any) -> T:
    start = time.perf_counter()
    result = function(*arguments)
    times.setdefault(name, []).append(time.perf_counter() - start)
    return result


def _clouds(bag: Path) -> list[Any]:
    from rosbags.highlevel import AnyReader

    with AnyReader([bag]) as reader:
        wanted = [c for c in reader.connections if c.msgtype.endswith("PointCloud2")]
        return [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(wanted)]


def _scene(bag: Path) -> Any:
    with BagSource([bag], load()) as source:
        return source.scene


def _script(name: str, *arguments: str) -> list[str]:
    return [str(Path(sys.executable).with_name(name)), *arguments]


def _default_model() -> Path | None:
    model = Path(__file__).resolve().parents[2] / "shared/data/models/yolox_nano.onnx"
    return model if model.exists() else None


if __name__ == "__main__":
    main()
