"""Collect the evidence about one subject from the stages of a frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F32, I32, I64
from bevviz.model.results import ClusterState, FrameResult
from bevviz.support.numba_kernel import kernel
from bevviz.why.evidence import Candidate, ClusterPart, Evidence
from bevviz.why.frame_index import FEW, PART, Fate, FrameIndex
from bevviz.why.merged_clusters import LOOKED_AT, find_mates, least_distance, separation
from bevviz.why.subject import Subject
from bevviz.why.subject_matches import find_candidates, find_reported_object, sort_candidates

NEARER = 0.5  # metres by which a return must be nearer to hide the subject
CORE = 0.8  # share of the directions of a box; an object does not fill the corners of its box


def collect_evidence(subject: Subject, traces: FrameIndex) -> Evidence:
    """Collect the points, clusters and detections of the subject, stage by stage."""
    result = traces.result
    voxels, ground = result.voxels, result.ground
    points = traces.place(subject)
    front_rows, aimed = _returns_in_front(subject, traces)
    fate = np.zeros(len(result.frame.points), np.uint8)
    fate[front_rows] = Fate.IN_FRONT
    fate[points] = traces.fate[points]
    rows, heights = np.zeros(0, np.int64), np.zeros(0, np.float32)
    obstacle, labels = np.zeros(0, np.int64), np.zeros(0, np.int32)
    noise = np.zeros(0, np.int64)
    if voxels is not None and ground is not None:
        rows = np.unique(voxels.inverse[points]).astype(np.int64)
        heights = ground.height[rows[traces.obstacle[rows] < 0]]
        obstacle = traces.obstacle[rows][traces.obstacle[rows] >= 0]
        if result.clusters is not None:
            labels = result.clusters.labels[obstacle]
            noise = obstacle[(labels < 0) & (traces.first_labels[obstacle] < 0)]
    parts = _parts(labels, result)
    candidates = find_candidates(subject, traces, parts)
    main = _main_cluster(subject, parts, candidates, len(labels))
    named = find_reported_object(subject, traces, parts, candidates)
    if named is not None and named.cluster >= 0:
        main = named.cluster
    center = center_of(subject, result, main)
    candidates = sort_candidates(candidates, subject, main, result.config.detector.conf_threshold)
    mates = find_mates(subject, traces, main)
    gap, finer, joined_by = separation(subject, traces, main, mates)
    hiding = traces.cluster[front_rows]
    hiding = hiding[hiding >= 0]
    config = result.config.clustering
    return Evidence(
        points=points,
        fate=fate,
        center=center,
        distance=ground_distance(center, result.frame.points[points]),
        voxels=len(rows),
        ground=heights,
        noise=len(noise),
        neighbours=_most_neighbours(result.obstacles, noise, config.eps)
        if traces.origin("clustering").ours
        else 0,
        parts=parts,
        main=main,
        aimed=aimed,
        in_front=len(front_rows),
        front=int(np.bincount(hiding).argmax()) if len(hiding) else -1,
        candidates=candidates,
        named=named,
        mates=tuple(mates),
        gap=gap,
        finer=finer,
        joined_by=joined_by,
        apart=_largest_gap(result, parts),
        in_view=bool(candidates) or traces.in_view(subject),
    )


# --- LiDAR -------------------------------------------------------------------------------------


def _parts(labels: I32, result: FrameResult) -> tuple[ClusterPart, ...]:
    """Return the clusters of (M,) labels, the one with most points first."""
    cluster_rows, points = np.unique(labels[labels >= 0], return_counts=True)
    clusters = result.clusters
    if clusters is None:
        return ()
    order = np.argsort(-points, kind="stable")
    return tuple(
        ClusterPart(int(k), int(n), int(clusters.count[k]), ClusterState(int(clusters.state[k])))
        for k, n in zip(cluster_rows[order], points[order], strict=True)
    )


def _main_cluster(
    subject: Subject, parts: Sequence[ClusterPart], candidates: Sequence[Candidate], obstacles: int
) -> int:
    """Return the kept cluster of the subject, -1 if it holds only few of its points."""
    # The frustum of a detection also holds clusters behind the object. The fusion has chosen one of them.
    if subject.kind == "detection":
        return next(
            (candidate.cluster for candidate in candidates if candidate.kept and candidate.cluster >= 0), -1
        )
    least = 1 if subject.is_place else max(FEW, PART * obstacles)
    return next((part.cluster for part in parts if part.kept and part.points >= least), -1)


def _returns_in_front(subject: Subject, traces: FrameIndex) -> tuple[I64, int]:
    """Return the rows of the returns that end before the subject, and the number of returns in its direction.

    Directions start at the origin of the points. With one LiDAR, this is the LiDAR itself.
    """
    nothing = np.zeros(0, np.int64)
    if subject.box is None:
        return nothing, 0
    corners, center = geometry.corners(subject.box)[0], subject.box.center[0]
    away = np.hypot(corners[:, 0], corners[:, 1])
    if np.hypot(*center[:2]) < np.hypot(*subject.box.size[0, :2]) / 2:
        return nothing, 0  # the sensor is inside the box
    seen = traces.directions
    middle = np.arctan2(center[1], center[0])
    turned = CORE * _wrap_angles(np.arctan2(corners[:, 1], corners[:, 0]) - middle)
    elevation = np.arctan2(corners[:, 2], away)
    half = CORE * (elevation.max() - elevation.min()) / 2
    rows = seen.between(middle + turned.min(), middle + turned.max())
    aimed = rows[np.abs(seen.elevation[rows] - (elevation.max() + elevation.min()) / 2) < half]
    before = aimed[seen.away[aimed] < away.min() - NEARER]
    return np.sort(seen.row[before]), len(aimed)


def _wrap_angles(angle: F32) -> F32:
    """Wrap angles to [-pi, pi)."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi, np.float32)


def _most_neighbours(obstacles: F32 | None, noise: I64, eps: float) -> int:
    """Return the most neighbours within ``eps`` that a noise point has, itself included."""
    if obstacles is None or len(noise) == 0:
        return 0
    noise_points = obstacles[noise[:: 1 + len(noise) // LOOKED_AT]]
    near = ((obstacles > noise_points.min(0) - eps) & (obstacles < noise_points.max(0) + eps)).all(axis=1)
    return int(_most_around(noise_points, obstacles[near], eps * eps))


@kernel
def _most_around(centers: F32, points: F32, eps2: float) -> int:
    """Return the largest number of points within a distance of a point of ``own``."""
    largest = 0
    for i in range(len(centers)):
        count = 0
        for j in range(len(points)):
            square = 0.0
            for axis in range(3):
                square += (np.float64(centers[i, axis]) - points[j, axis]) ** 2
            count += square < eps2
        largest = max(largest, count)
    return largest


def center_of(subject: Subject, result: FrameResult, main: int) -> tuple[float, float, float] | None:
    """Return the centre of the subject's box, or of the box of its cluster."""
    boxes, row = subject.box, 0
    if boxes is None and main >= 0 and result.clusters is not None:
        boxes, row = result.clusters.boxes(result.config.clustering), main
    if boxes is None:
        return None
    x, y, z = boxes.center[row].tolist()
    return x, y, z


def ground_distance(center: tuple[float, float, float] | None, points: F32) -> float:
    """Return the metres on the ground to a centre, or the median of the points; NaN without both."""
    if center is not None:
        return float(np.hypot(*center[:2]))
    return float(np.median(np.hypot(*points[:, :2].T))) if len(points) else float("nan")


def _largest_gap(result: FrameResult, parts: Sequence[ClusterPart]) -> float:
    """Return the metres between the two largest kept clusters, NaN without two."""
    kept = [part for part in parts if part.kept]
    if len(kept) < 2 or result.clusters is None or result.obstacles is None:
        return float("nan")
    first, second = (result.obstacles[result.clusters.labels == part.cluster] for part in kept[:2])
    return least_distance(first, second)
