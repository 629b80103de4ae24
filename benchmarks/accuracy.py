"""How well the pipeline sees: ground, clusters, detections, fused objects and tracks against exact truth.

Runs both presets on the same frames of synthetic drives that the demo network was not trained on.
"""

from __future__ import annotations

import argparse
import platform
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tqdm import tqdm

from benchmarks import kitti
from benchmarks.pages import write_section
from bevviz.config import Preset, load
from bevviz.evaluate import MAX_DISTANCE, MIN_HITS, RANGE, pair_in_order
from bevviz.extras.demo.drive import Snapshot, SyntheticSource
from bevviz.model.geometry import iou
from bevviz.model.results import DetectionState, FrameResult
from bevviz.pipeline.session import Session
from tests.support.track_metrics import Tallies, TrackTally, add_tracks, moved, truth_of, without_pose

PRESETS: tuple[Preset, ...] = ("reference", "default")
CLASSES = ("person", "cyclist", "car")
# Source of the robot's motion, and the setting that makes it.
MOTIONS = {
    "stated": "odometry.method=auto",
    "estimated": "odometry.method=auto",
    "unknown": "odometry.method=none",
}
MIN_HEIGHT = 20  # visible pixels in height of an object that must be found

SYNTHETIC = f"""## Objects on synthetic drives

`python -m benchmarks.accuracy` runs the demo network on drives that it was not trained on. An object must
be found within {RANGE:.0f} m, with {MIN_HITS} LiDAR points and {MIN_HEIGHT} px of visible height or more.
A fused box is right if an object of its class has its centre within {MAX_DISTANCE:.0f} m.
"""


@dataclass
class Tally:
    """Counts of one preset."""

    ground: Counter[str] = field(default_factory=Counter)
    clusters: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    detections: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    objects: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    errors: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[1000, 1001, 1002], help="drives")
    parser.add_argument("--frames", type=int, default=100, help="length of each drive in scans")
    parser.add_argument("--every", type=int, default=5, help="each N-th scan is measured")
    parser.add_argument(
        "--tracked", type=int, default=50, help="of each drive, scans in a row that tracking is measured on"
    )
    parser.add_argument(
        "--tracked-seeds",
        type=int,
        nargs="+",
        default=[1010, 1011, 1012],  # the tracker's defaults were chosen on 1000 and 1001
        help="drives that tracking is measured on",
    )
    parser.add_argument("--data", type=Path, default=kitti.DATA, help="folder of real frames and models")
    parser.add_argument("--write", type=Path, help="page whose sections are replaced, instead of printing")
    options = parser.parse_args()

    tallies = {preset: Tally() for preset in PRESETS}
    sessions = {p: Session(load(settings=["detector.model=demo"], preset=p)) for p in PRESETS}
    shots = [(seed, index) for seed in options.seeds for index in range(0, options.frames, options.every)]
    sources = {seed: SyntheticSource(options.frames, seed) for seed in options.seeds}
    for seed, index in tqdm(shots, unit="frame", disable=None):
        shot = sources[seed].snapshot(index)
        for preset, tally in tallies.items():
            result = sessions[preset].run(shot.frame)
            if result.failures:
                raise SystemExit(f"seed {seed}, frame {index}, {preset}: {result.failures}")
            add_ground(tally, shot, result)
            add_clusters(tally, shot, result)
            add_detections(tally, shot, result)
            add_objects(tally, shot, result)
    tracked = {motion: Tallies(TrackTally) for motion in MOTIONS}
    for seed in options.tracked_seeds:
        track(tracked, SyntheticSource(options.frames, seed), options.tracked)
    sections = [kitti.section(options.data)] if (options.data / "kitti").is_dir() else []
    sections.append(
        SYNTHETIC
        + f"\n{len(shots)} frames, seeds {options.seeds}, Python {platform.python_version()}.\n"
        + tables(tallies)
        + track_table(tracked, options.tracked, options.tracked_seeds)
    )
    for section in sections:
        if options.write:
            write_section(options.write, section)
        else:
            print(section)
    if options.write is None:
        print(details(tallies))


def track(tallies: Mapping[str, Tallies], source: SyntheticSource, frames: int) -> None:
    """Run the default preset over the first ``frames`` scans of a drive and tally the tracks by motion."""
    model = "detector.model=demo"
    sessions = {motion: Session(load(settings=[model, setting])) for motion, setting in MOTIONS.items()}
    for index in tqdm(range(min(frames, source.total)), unit="scan", disable=None):
        shot = source.snapshot(index)
        truth = truth_of(source, shot, required(shot)[0])
        for motion, session in sessions.items():
            result = session.run(shot.frame if motion == "stated" else without_pose(shot.frame))
            assert result.tracks is not None
            world_from_map = result.frame.pose @ np.linalg.inv(shot.frame.pose)
            add_tracks(tallies[motion], source.seed, result.tracks, moved(truth, world_from_map))


def add_ground(tally: Tally, shot: Snapshot, result: FrameResult) -> None:
    """Per raw point: is ground called ground, and does every point of an object stay an obstacle?"""
    assert result.ground is not None and result.voxels is not None
    called, true, on_object = (
        result.ground.mask[result.voxels.inverse],
        shot.point_ground,
        shot.point_object > 0,
    )
    tally.ground["tp"] += int((called & true).sum())
    tally.ground["fp"] += int((called & ~true).sum())
    tally.ground["fn"] += int((~called & true).sum())
    tally.ground["object kept"] += int((~called & on_object).sum())
    tally.ground["object"] += int(on_object.sum())


def required(shot: Snapshot) -> tuple[np.ndarray, np.ndarray]:
    """For each truth box: must it be found, and its visible image box (K, 4), NaN where there is none."""
    assert shot.frame.truth is not None
    truth = shot.frame.truth
    boxes = np.full((len(truth.boxes), 4), np.nan, np.float32)
    must = np.zeros(len(boxes), bool)
    for row, number in enumerate(shot.truth_object):
        ys, xs = np.nonzero(shot.pixel_object == number)
        if len(xs) == 0:
            continue
        boxes[row] = xs.min(), ys.min(), xs.max(), ys.max()
        near = np.hypot(*truth.boxes.center[row, :2]) <= RANGE
        tall = ys.max() - ys.min() >= MIN_HEIGHT
        must[row] = near and tall and shot.truth_hits[row] >= MIN_HITS
    return must, boxes


def add_clusters(tally: Tally, shot: Snapshot, result: FrameResult) -> None:
    """Tally the clustered objects: one kept cluster holds most of the object's points and little else."""
    assert result.clusters is not None and result.voxels is not None and result.ground is not None
    assert shot.frame.truth is not None
    _, first = np.unique(result.voxels.inverse, return_index=True)
    owner = shot.point_object[first][~result.ground.mask]
    must, _ = required(shot)
    for row in np.flatnonzero(must):
        name = shot.frame.truth.labels[row]
        labels = result.clusters.labels[owner == shot.truth_object[row]]
        held = np.bincount(labels[labels >= 0], minlength=len(result.clusters))
        tally.clusters[name]["all"] += 1
        if len(held) == 0 or held.max() == 0:
            continue
        best = int(held.argmax())
        whole = held[best] >= 0.5 * len(labels)
        pure = held[best] >= 0.5 * result.clusters.count[best]
        tally.clusters[name]["alone"] += int(whole and pure and result.clusters.state[best] == 0)


def add_detections(tally: Tally, shot: Snapshot, result: FrameResult) -> None:
    """Image boxes at IoU 0.5 with the visible part."""
    assert shot.frame.truth is not None
    detections = result.cameras[0].detections
    assert detections is not None
    must, boxes = required(shot)
    kept = np.flatnonzero(detections.state == DetectionState.KEPT)
    for name in CLASSES:
        mine = np.array([d for d in kept if detections.names[d] == name], int)
        rows = np.array([r for r, label in enumerate(shot.frame.truth.labels) if label == name], int)
        rows = rows[np.isfinite(boxes[rows, 0])] if len(rows) else rows
        distance = (
            1 - iou(detections.xyxy[mine], boxes[rows])
            if len(mine) and len(rows)
            else np.zeros((len(mine), len(rows)))
        )
        count(tally.detections[name], distance, must[rows], 0.5)


def add_objects(tally: Tally, shot: Snapshot, result: FrameResult) -> None:
    assert shot.frame.truth is not None and result.objects is not None
    truth = shot.frame.truth
    must, _ = required(shot)
    for name in CLASSES:
        mine = np.array([j for j, n in enumerate(result.objects.names) if n == name], int)
        mine = mine[np.argsort(-result.objects.score[mine])] if len(mine) else mine
        rows = np.array([r for r, label in enumerate(truth.labels) if label == name], int)
        offset = result.objects.boxes.center[mine][:, None, :2] - truth.boxes.center[rows][None, :, :2]
        distance = (
            np.linalg.norm(offset, axis=2) if len(mine) and len(rows) else np.zeros((len(mine), len(rows)))
        )
        tally.errors[name] += count(tally.objects[name], distance, must[rows], MAX_DISTANCE)


def count(counts: Counter[str], distance: np.ndarray, must: np.ndarray, limit: float) -> list[float]:
    """Greedy one-to-one matches, best first; one with an object that need not be found counts for nothing."""
    partners, free = pair_in_order(distance, limit)
    right = (partners >= 0) & np.append(must, False)[partners]
    counts["tp"] += int(right.sum())
    counts["fp"] += int((partners < 0).sum())
    counts["fn"] += int((free & must).sum())
    return [float(distance[row, partners[row]]) for row in np.flatnonzero(right)]


def share(part: float, whole: float) -> str:
    return f"{part / whole:.3f}" if whole else "-"


def details(tallies: dict[Preset, Tally]) -> str:
    """Format the tables of ground, clusters and detections, which are printed but not on the page."""
    lines = [
        "\n### Ground\n",
        "| preset | precision | recall | IoU | object points kept |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for preset, tally in tallies.items():
        g = tally.ground
        lines.append(
            f"| {preset} | {share(g['tp'], g['tp'] + g['fp'])} | {share(g['tp'], g['tp'] + g['fn'])} "
            f"| {share(g['tp'], g['tp'] + g['fp'] + g['fn'])} | {share(g['object kept'], g['object'])} |"
        )
    lines.append("\n### Clusters: objects that have one of their own\n")
    lines.append("| class | objects | " + " | ".join(tallies) + " |")
    lines.append("| --- | ---: |" + " ---: |" * len(tallies))
    for name in CLASSES:
        first = next(iter(tallies.values()))
        shares = [share(t.clusters[name]["alone"], t.clusters[name]["all"]) for t in tallies.values()]
        lines.append(f"| {name} | {first.clusters[name]['all']} | " + " | ".join(shares) + " |")
    lines.append("\n### Image detections: demo network, IoU 0.5, the same in both presets\n")
    lines += ["| class | objects | precision | recall |", "| --- | ---: | ---: | ---: |"]
    for name in CLASSES:
        c = tallies["default"].detections[name]
        found, all_found, all_there = c["tp"], c["tp"] + c["fp"], c["tp"] + c["fn"]
        lines.append(f"| {name} | {all_there} | {share(found, all_found)} | {share(found, all_there)} |")
    return "\n".join(lines) + "\n"


def tables(tallies: dict[Preset, Tally]) -> str:
    """Format the table of fused objects."""
    lines = [
        "\n### Fused objects: class and place\n",
        "| class | preset | precision | recall | centre error, median m | 90 % m |",
        "| --- | --- | ---: | ---: | ---: | ---: |",
    ]
    for name in (*CLASSES, "all"):
        for preset, tally in tallies.items():
            chosen = CLASSES if name == "all" else (name,)
            c = sum((tally.objects[n] for n in chosen), Counter())
            precision, recall = share(c["tp"], c["tp"] + c["fp"]), share(c["tp"], c["tp"] + c["fn"])
            errors = [e for n in chosen for e in tally.errors[n]]
            middle, most = (f"{q:.2f}" for q in np.quantile(errors, (0.5, 0.9))) if errors else ("-", "-")
            lines.append(f"| {name} | {preset} | {precision} | {recall} | {middle} | {most} |")
    return "\n".join(lines) + "\n"


def track_table(tallies: Mapping[str, Tallies], frames: int, seeds: list[int]) -> str:
    lines = [
        "\n### Tracks: ids and speeds, `default` preset\n",
        f"{frames} scans in a row of each of the drives {seeds}. Tracks count that are shown and have a",
        "cluster. Speed errors are those of tracks older than a second.\n",
        "| class | MOTA | IDF1 | precision | recall | id switches | speed error, median m/s | 90 % m/s |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name in CLASSES:
        tally, c = tallies["stated"][name], tallies["stated"][name].counts
        precision, recall = c["tp"] / max(c["tp"] + c["fp"], 1), c["tp"] / max(c["tp"] + c["fn"], 1)
        middle, most = np.quantile(tally.speeds, (0.5, 0.9)) if tally.speeds else (np.nan, np.nan)
        lines.append(
            f"| {name} | {tally.mota:.3f} | {tally.idf1:.3f} | {precision:.3f} | {recall:.3f} "
            f"| {c['switches']} | {middle:.2f} | {most:.2f} |"
        )
    lines += [
        "\nThe same if the motion is stated, estimated (`odometry.method`) or unknown:\n",
        f"| motion | MOTA {', '.join(CLASSES)} | id switches | speed error, median m/s |",
        "| --- | ---: | ---: | ---: |",
    ]
    for motion, tally_of in tallies.items():
        classes = [tally_of[name] for name in CLASSES]
        mota = ", ".join(f"{tally.mota:.3f}" for tally in classes)
        switches = sum(tally.counts["switches"] for tally in classes)
        speed = np.median(np.concatenate([tally.speeds for tally in classes]))
        lines.append(f"| {motion} | {mota} | {switches} | {speed:.2f} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
