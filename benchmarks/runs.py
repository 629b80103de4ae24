"""Whole runs, each in a process of its own, its start included.

``python -m benchmarks.runs`` prints the rows of ``bag`` without a network against ``rerun mcap convert``.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader
from tqdm import tqdm

from benchmarks import bags
from benchmarks.measure import Finished, Times, machine, run
from bevviz.bags.bag import Recording
from bevviz.messages.clouds import decode_cloud
from bevviz.recording import entities


def compare(bag: Path, repetitions: int) -> list[str]:
    """Rows of the bag as a recording, against ``rerun mcap convert``, of its growth, and of the start."""
    converted, saved, short = (bag.with_name(f"{name}.rrd") for name in ("converted", "saved", "short"))
    scans, points, received = counted(bag)
    few = scans // 10
    convert, run_bag = ("rerun", "mcap", "convert", str(bag), "-o"), ("bevviz", "bag", str(bag), "--save")
    commands = {
        "theirs": (*convert, str(converted)),
        "ours": (*run_bag, str(saved)),
        "their few": (*convert, str(short), "--end-time", str(received[few])),
        "our few": (*run_bag, str(short), "--frames", f":{few}"),
        "our first": (*run_bag, str(short), "--frames", ":1"),
        "help": ("bevviz", "--help"),
        "info": ("bevviz", "info", str(bag)),
    }
    for name in ("help", "info"):
        run(*commands[name])
    found: dict[str, list[Finished]] = {name: [] for name in commands}
    for _ in tqdm(range(repetitions), unit="run", desc="bag to .rrd", disable=None):
        for name, command in commands.items():
            for _ in range(3 if name in ("help", "info") else 1):
                found[name].append(run(*command))
    times = {name: Times([f.seconds for f in all_]) for name, all_ in found.items()}
    memory = {name: max(f.memory for f in all_) for name, all_ in found.items()}
    if logged_points(saved) != points:
        raise SystemExit("points of the bag are missing in the recording")

    used = {name: Times([f.processor for f in all_]) for name, all_ in found.items()}

    def further(more: str, fewer: str, number: int, times: dict[str, Times] = times) -> float:
        """Milliseconds for each scan beyond the fewer ones."""
        return 1e3 * (times[more].median - times[fewer].median) / number

    about = f"{scans} scans, {bag.stat().st_size / 1e9:.2f} GB"
    theirs, ours = times["theirs"], times["ours"]
    big, small = converted.stat().st_size, saved.stat().st_size
    slope, our_slope = further("theirs", "their few", scans - few), further("ours", "our few", scans - few)
    work, our_work = (
        further("theirs", "their few", scans - few, used),
        further("ours", "our few", scans - few, used),
    )
    early, late = further("our few", "our first", few - 1), further("ours", "our first", scans - 1)
    least, most = memory["our few"], memory["ours"]
    return [
        f"| bag to .rrd, no network, {about} | rerun mcap convert | {theirs} | {ours} "
        f"| {theirs.median / ours.median:.2f} x | 1 x | |",
        f"| each further scan of it | rerun mcap convert | {slope:.1f} ms | {our_slope:.1f} ms "
        f"| {slope / our_slope:.2f} x | 1 x | |",
        f"| processor time of each further scan | rerun mcap convert | {work:.1f} ms | {our_work:.1f} ms "
        f"| {work / our_work:.2f} x | | |",
        f"| cores that a further scan keeps busy | rerun mcap convert | {work / slope:.2f} "
        f"| {our_work / our_slope:.2f} | | 1.8 | |",
        f"| .rrd, everything in it | rerun mcap convert | {big / 1e6:.0f} MB | {small / 1e6:.0f} MB "
        f"| {small / big:.2f} | 0.5 | every point there |",
        f"| time, frames x 10 ({few}, {scans}), beyond the start of {times['our first'].median:.2g} s | "
        f"| {early:.1f} ms a frame | {late:.1f} ms a frame | {late / early:.2f} x | 1 x | |",
        f"| memory, frames x 10 | | {least:.0f} MB | {most:.0f} MB | {most / least:.2f} x | 1 x | |",
        f"| `bevviz --help` | | | {times['help']} | | 0.3 s | |",
        f"| `bevviz info`, the same bag | | | {times['info']} | | 1 s | |",
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


def counted(bag: Path) -> tuple[int, int, list[int]]:
    """Count the scans of a bag and their finite points. Also return the receive times in nanoseconds."""
    points, received = 0, []
    with Recording([bag]) as recording:
        topics = [t.name for t in recording.topics if t.type.endswith("PointCloud2")]
        for message in recording.messages(topics):
            points += len(decode_cloud(recording.decode(message), message.topic, 0).xyz)
            received.append(message.received)
    return len(received), points, received


def logged_points(recording: Path) -> int:
    """Raw points in a recording: those of each LiDAR, not their copies among ground and obstacles."""
    total = 0
    for chunk in RrdReader(recording).stream():
        path = chunk.entity_path
        if (
            chunk.is_static
            or not path.endswith("/points")
            or path != entities.POINTS.path(path.split("/")[2])
        ):
            continue
        batch = chunk.to_record_batch()
        if "Points3D:positions" in batch.schema.names:
            column = batch.column("Points3D:positions")
            total += int(np.sum(column.value_lengths().drop_null().to_numpy(zero_copy_only=False)))
    return total


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=float, default=1.0, help="GB of the bag (default: 1, 280 scans)")
    parser.add_argument("--repetitions", type=int, default=3, metavar="N", help="of each run (default: 3)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        drive = bags.simulate(40, Path(name) / "drive.mcap")
        bag = bags.repeat(drive, Path(name) / "repeated", int(1e9 * options.size))
        print(machine(), *compare(bag, options.repetitions), sep="\n")


if __name__ == "__main__":
    main()
