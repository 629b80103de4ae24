"""The stages in this process: against the tutorial's calls, by themselves, and as their input grows.

``python -m benchmarks.stages`` states the processor time of a frame with YOLOX-nano's detections.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks import tutorial
from benchmarks.measure import Times, default_model, interleaved
from bevviz.config import load
from bevviz.extras.demo.drive import SyntheticSource
from bevviz.messages.clouds import decode_cloud
from bevviz.model.frame import F32, I32, Camera, Frame, Scene
from bevviz.model.results import Detections
from bevviz.pipeline.perceive import add_explanations
from bevviz.pipeline.session import Session
from bevviz.recording.frame_logger import FrameLogger
from bevviz.recording.sinks import open_recording
from bevviz.stages.bev import bev
from bevviz.stages.clustering import cluster, dbscan
from bevviz.stages.ground import segment_ground
from bevviz.stages.voxel import voxel_grid

STAGES = ("voxel", "ground", "clustering", "projection", "bev", "explain")
EPS, MIN_POINTS = 0.5, 50


def row(what: str, against: str, times: Sequence[Times], wanted: float, same: str) -> str:
    theirs, ours = times
    ratio = theirs.median / ours.median
    return f"| {what} | {against} | {theirs} | {ours} | {ratio:.1f} x | {wanted:g} x | {same} |"


def compare(messages: Sequence[Any], frames: Sequence[Frame], scene: Scene, repetitions: int) -> list[str]:
    """Rows of the stages, each against the tutorial's calls on the same input."""
    reference, config = tutorial.Stages(), load()
    message, frame = messages[0], frames[0]
    rows = []

    def decode() -> F32:
        return decode_cloud(message, "/points", 0).xyz

    times = interleaved(max(3, repetitions // 3), lambda: tutorial.decode(message), decode)
    same = np.array_equal(tutorial.decode(message), decode())
    what = f"PointCloud2 to arrays, {message.width * message.height} points"
    rows.append(row(what, "a Python generator into np.fromiter", times, 50, _said(same, "arrays equal")))

    as_tutorial = load(settings=["detector.model=demo"], preset="reference")
    session = Session(as_tutorial)
    results = [session.run(f) for f in frames[:: max(1, len(frames) // 5)]]
    drawn = next((r for r in results if r.objects), results[0])
    points, inverse = drawn.frame.points, drawn.voxels.inverse if drawn.voxels else np.zeros(0, np.int32)
    ground = drawn.ground.mask[inverse] if drawn.ground else None

    def draw() -> Any:
        return bev(points, None, ground, drawn.objects, drawn.clusters, as_tutorial.bev).image

    times = interleaved(3 * repetitions, lambda: tutorial.bev(points, drawn.objects), draw)
    same = np.array_equal(tutorial.bev(points, drawn.objects), draw())
    what = f"bird's-eye image, `reference`, {len(drawn.objects or ())} boxes"
    rows.append(row(what, "the tutorial's NumPy code", times, 3, _said(same, "pixels equal")))

    obstacles = [r.obstacles for r in results if r.obstacles is not None]
    points = side_by_side(obstacles, 100_000)
    cloud = reference.cloud(points)
    times = interleaved(
        repetitions, partial(reference.labels, cloud), partial(dbscan, points, EPS, MIN_POINTS)
    )
    same = same_clusters(points, dbscan(points, EPS, MIN_POINTS), reference.labels(cloud))
    what = f"clustering, {len(points)} points"
    rows.append(row(what, "Open3D cluster_dbscan(0.5, 50)", times, 8, _said(same, "labels equal")))

    def theirs() -> None:
        reference.clustering(reference.ground(reference.voxel(frame.points)))

    def ours() -> None:
        voxels = voxel_grid(frame.points, config.voxel)
        ground = segment_ground(voxels.points, config.ground)
        cluster(voxels.points.compress(~ground.mask, axis=0), config.clustering)

    times = interleaved(repetitions, theirs, ours)
    against = "Open3D voxel_down_sample, segment_plane, cluster_dbscan"
    rows.append(row("voxel, ground and clustering, `default`", against, times, 6, "other methods"))

    with lidar_side(scene) as process:
        (times_all,) = interleaved(repetitions, lambda: process(message, frame))
    rows.append(
        f"| LiDAR side of a frame, message to logged result | a 10 Hz sensor | 100 ms | {times_all} "
        f"| {1 / times_all.median:.0f} Hz | 40 Hz | |"
    )
    return rows


@contextmanager
def lidar_side(scene: Scene) -> Iterator[Any]:
    """Everything that becomes of a cloud, on one thread: decoded, through the stages, and logged."""
    config = load()
    with (
        TemporaryDirectory() as folder,
        open_recording(scene, config, save=Path(folder, "x.rrd")) as sinks,
    ):
        session, logger = Session(config), FrameLogger(sinks.recording, config, scene)
        logger.log_static()

        def process(message: Any, frame: Frame) -> None:
            cloud = decode_cloud(message, "/points", frame.received)
            logger.log(
                session.run(
                    replace(frame, points=cloud.xyz, fields=cloud.fields, clouds=(cloud,), cameras=())
                )
            )

        yield process


def side_by_side(clouds: Sequence[F32], count: int) -> F32:
    """(count, 3) points of several scans, each moved away from the others: no denser than one."""
    parts: list[F32] = []
    while sum(map(len, parts)) < count:
        parts.append(clouds[len(parts) % len(clouds)] + np.array([0, 300 * len(parts), 0], np.float32))
    return np.ascontiguousarray(np.concatenate(parts)[:count])


def same_clusters(points: F32, ours: I32, theirs: I32) -> bool:
    """Whether the noise is the same and so are the clusters, up to their numbers and their border points."""
    if not np.array_equal(ours < 0, theirs < 0):
        return False
    labels = np.stack([ours, theirs], axis=1)
    pairs, which, counts = np.unique(labels, axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(-counts)
    partner: dict[int, int] = {}
    taken: dict[int, int] = {}
    for a, b in pairs[order].tolist():
        partner.setdefault(a, b)
        taken.setdefault(b, a)
    apart = [k for k, (a, b) in enumerate(pairs.tolist()) if partner[a] != b or taken[b] != a]
    doubtful = np.flatnonzero(np.isin(which.ravel(), apart))
    exact = points.astype(np.float64)
    return all(
        np.count_nonzero(((exact - exact[i]) ** 2).sum(axis=1) < EPS**2) < MIN_POINTS for i in doubtful
    )


def profile(messages: Sequence[Any], frames: Sequence[Frame], scene: Scene) -> list[str]:
    """Where the time of a frame goes, camera included but for the network."""
    times: dict[str, list[float]] = defaultdict(list)
    config = load()
    with (
        TemporaryDirectory() as folder,
        open_recording(scene, config, save=Path(folder, "x.rrd")) as sinks,
    ):
        session, logger = Session(config), FrameLogger(sinks.recording, config, scene)
        logger.log_static()
        logger.log(session.run(frames[0]))
        bar = tqdm(frames, unit="frame", desc="stages", disable=None)
        for frame, message in zip(bar, messages, strict=True):
            start = time.perf_counter()
            decode_cloud(message, "/points", 0)
            times["decode"].append(time.perf_counter() - start)
            result = session.run(frame)
            for stage in STAGES:
                times[stage].append(result.timings.get(stage, 0.0))
            start = time.perf_counter()
            logger.log(result)
            times["log"].append(time.perf_counter() - start)
    cells = [f"{1e3 * median(found):.1f} ({1e3 * min(found):.1f})" for found in times.values()]
    return [
        "| ms of a frame | " + " | ".join(times) + " |",
        "| --- |" + " ---: |" * len(times),
        "| `default` | " + " | ".join(cells) + " |",
    ]


def growth(messages: Sequence[Any], frames: Sequence[Frame], scene: Scene, repetitions: int) -> list[str]:
    """Rows of points x 2 and detections x 10."""
    frame = frames[0]
    half = replace(frame, points=np.ascontiguousarray(frame.points[::2]), fields={}, clouds=(), cameras=())
    whole = replace(frame, fields={}, clouds=(), cameras=())
    session = Session(load())
    few, many = interleaved(repetitions, lambda: session.run(half), lambda: session.run(whole))
    what = f"time, points x 2 ({len(half.points)}, {len(whole.points)})"
    rows = [_growth(what, few, many, 2)]

    config = load()
    counts = (20, 200)
    with (
        TemporaryDirectory() as folder,
        open_recording(scene, config, save=Path(folder, "x.rrd")) as sinks,
    ):
        logger = FrameLogger(sinks.recording, config, scene)
        sessions = {n: Session(config, partial(_found, scattered(n, frame))) for n in counts}

        def detect(count: int) -> None:
            logger.log(sessions[count].run(frame))

        few, many = interleaved(repetitions, *(partial(detect, n) for n in counts))
    return [
        *rows,
        _growth(f"time, detections x 10 ({counts[0]}, {counts[1]}), all of a frame", few, many, 10),
    ]


def scattered(count: int, frame: Frame) -> Detections:
    """Kept detections of all sizes all over the frame's first image."""
    rng = np.random.default_rng(0)
    intrinsics = frame.cameras[0].intrinsics
    assert intrinsics is not None
    size = np.array([intrinsics.width, intrinsics.height])
    low = rng.uniform(0, 0.8, (count, 2)) * size
    high = np.minimum(low + rng.uniform(0.02, 0.3, (count, 2)) * size, size)
    none = np.zeros(count, np.int32)
    return Detections(
        xyxy=np.concatenate([low, high], axis=1).astype(np.float32),
        score=np.sort(rng.uniform(0.3, 1, count))[::-1].astype(np.float32),
        class_id=none,
        names=("car",) * count,
        state=none,
        suppressed_by=none - 1,
        overlap=np.zeros(count, np.float32),
    )


def _found(detections: Detections, camera: Camera) -> Detections:
    return detections


def _growth(what: str, few: Times, many: Times, factor: int) -> str:
    ratio = many.median / few.median
    return f"| {what} | | {few} | {many} | {ratio:.1f} x | {factor} x at most | |"


def _said(same: bool, what: str) -> str:
    if not same:
        raise SystemExit(f"not {what}")
    return what


def with_detections(count: int = 30, rounds: int = 5) -> dict[str, float]:
    """Milliseconds of processor time of a simulated frame, by step, with the detections known before.

    Of each frame the fastest of ``rounds`` counts, and of these the mean.
    """
    frames = list(SyntheticSource(frames=count))
    config = load(settings=[f"detector.model={default_model() or 'demo'}"])
    alone = Session(config)
    known = {id(c.camera): c.detections for frame in frames for c in alone.run_single(frame).cameras}
    times = np.empty((rounds, count, 3))
    for by_frame in times:
        session = Session(config, lambda camera: known[id(camera)])
        for frame, spent in zip(frames, by_frame, strict=True):
            marks = [time.thread_time()]
            result = session.perceive(frame)
            for step in (add_explanations, session.add_anomalies):
                marks.append(time.thread_time())
                result = step(result)
            spent[:] = np.diff([*marks, time.thread_time()])
    mean = 1e3 * times.min(axis=0).mean(axis=0)
    return dict(zip(("perceive", "explanations", "anomalies"), mean.tolist(), strict=True))


if __name__ == "__main__":
    for what, milliseconds in with_detections().items():
        print(f"{what:14}{milliseconds:6.1f} ms")
