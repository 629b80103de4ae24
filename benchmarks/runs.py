"""Whole runs, each in a process of its own, its start included."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader
from tqdm import tqdm

from benchmarks.measure import Finished, Times, run
from bevviz.logging import entities
from bevviz.sources.messages import decode_cloud
from bevviz.sources.recording import Recording


def compare(bag: Path, repetitions: int) -> list[str]:
    """Rows of the bag as a recording, against ``rerun mcap convert``, and of the start."""
    converted, saved = bag.with_name("converted.rrd"), bag.with_name("saved.rrd")
    commands = {
        "theirs": ("rerun", "mcap", "convert", str(bag), "-o", str(converted)),
        "ours": ("bevviz", "bag", str(bag), "--save", str(saved)),
        "help": ("bevviz", "--help"),
        "info": ("bevviz", "info", str(bag)),
    }
    for name in ("help", "info"):
        run(*commands[name])
    found: dict[str, list[Finished]] = {name: [] for name in commands}
    for _ in tqdm(range(repetitions), unit="run", desc="bag to .rrd", disable=None):
        for name, command in commands.items():
            for _ in range(1 if name in ("theirs", "ours") else 3):
                found[name].append(run(*command))
    times = {name: Times([f.seconds for f in all_]) for name, all_ in found.items()}

    scans, points = counted(bag)
    if logged_points(saved) != points:
        raise SystemExit("points of the bag are missing in the recording")
    about = f"{scans} scans, {bag.stat().st_size / 1e9:.2f} GB"
    theirs, ours = times["theirs"], times["ours"]
    big, small = converted.stat().st_size, saved.stat().st_size
    return [
        f"| bag to .rrd, no network, {about} | rerun mcap convert | {theirs} | {ours} "
        f"| {theirs.median / ours.median:.2f} x | 1 x | |",
        f"| .rrd, everything in it | rerun mcap convert | {big / 1e6:.0f} MB | {small / 1e6:.0f} MB "
        f"| {small / big:.2f} | 0.5 | every point there |",
        f"| `bevviz --help` | | | {times['help']} | | 0.3 s | |",
        f"| `bevviz info`, the same bag | | | {times['info']} | | 1 s | |",
    ]


def growth(bag: Path) -> list[str]:
    """The row of frames x 10: seconds for each frame beyond the first one, and memory."""
    with Recording([bag]) as recording:
        scans = max(topic.count or 0 for topic in recording.topics if topic.type.endswith("PointCloud2"))
    counts = [1, scans // 10, scans]
    saved = bag.with_name("growth.rrd")
    one, few, many = (
        run("bevviz", "bag", str(bag), "--frames", f":{n}", "--save", str(saved)) for n in counts
    )
    slow, fast = ((f.seconds - one.seconds) / (n - 1) for f, n in ((few, counts[1]), (many, counts[2])))
    return [
        f"| time, frames x 10 ({counts[1]}, {counts[2]}), beyond the start of {one.seconds:.2g} s | "
        f"| {1e3 * slow:.1f} ms a frame | {1e3 * fast:.1f} ms a frame | {fast / slow:.2f} x | 1 x | |",
        f"| memory, frames x 10 | | {few.memory:.0f} MB | {many.memory:.0f} MB "
        f"| {many.memory / few.memory:.2f} x | 1 x | |",
    ]


def networks(bag: Path, frames: int, model: Path | None) -> list[str]:
    """Table of the runs with a network."""
    rows = [f"| network, {frames} frames | s | frames/s |", "| --- | ---: | ---: |"]
    for name, extra in [
        ("none", []),
        *([(model.stem, ["--model", str(model)])] if model else []),
        ("demo", ["--model", "demo"]),
    ]:
        done = run("bevviz", "bag", str(bag), "--save", str(bag.with_name("network.rrd")), *extra)
        rows.append(f"| {name} | {done.seconds:.1f} | {frames / done.seconds:.1f} |")
    return rows


def counted(bag: Path) -> tuple[int, int]:
    """Scans, and finite points in all of them."""
    with Recording([bag]) as recording:
        topics = [t.name for t in recording.topics if t.type.endswith("PointCloud2")]
        sizes = [len(decode_cloud(recording.decode(m), m.topic, 0).xyz) for m in recording.messages(topics)]
    return len(sizes), sum(sizes)


def logged_points(recording: Path) -> int:
    """Raw points in a recording: those of each LiDAR, not their copies among ground and obstacles."""
    total = 0
    for chunk in RrdReader(recording).stream():
        path = chunk.entity_path
        if chunk.is_static or not path.endswith("/points") or path != entities.points(path.split("/")[2]):
            continue
        batch = chunk.to_record_batch()
        if "Points3D:positions" in batch.schema.names:
            column = batch.column("Points3D:positions")
            total += int(np.sum(column.value_lengths().drop_null().to_numpy(zero_copy_only=False)))
    return total
