"""The numbers of one subject at each stage, from a frame's results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from bevviz import geometry
from bevviz.config import Config
from bevviz.frame import (
    F32,
    I32,
    I64,
    U8,
    Bool,
    CameraResult,
    ClusterState,
    Decision,
    DetectionState,
    FrameResult,
    Fusion,
)
from bevviz.stages.clustering import dbscan
from bevviz.why.subject import LINK, Subject, projected

NEARER = 0.5  # metres by which something must be nearer to hide what is behind it
SHARE = 0.2  # of an object's obstacle points: what a cluster must hold to be one of its clusters
FINER = (0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2)  # of clustering.eps, tried to tell merged objects apart


class Fate(IntEnum):
    """What became of a raw point."""

    ELSEWHERE = 0  # not one of the subject's
    GROUND = 1
    NOISE = 2
    SET_ASIDE = 3  # in a cluster outside the size limits
    CLUSTERED = 4  # in a cluster that no detection named
    REPORTED = 5  # in a cluster that became an object
    IN_FRONT = 6  # of the subject, and nearer: it hides it


@dataclass(frozen=True, slots=True)
class Part:
    """A cluster that has points at the place."""

    cluster: int
    points: int  # there
    count: int  # in all
    state: ClusterState


@dataclass(frozen=True, slots=True)
class Candidate:
    """A detection at the place, and what became of it."""

    camera: str
    row: int
    name: str
    score: float
    state: DetectionState
    overlap: float  # IoU with the projected subject; 1 for the subject itself
    decision: Decision
    cluster: int  # matched, or the best one that was refused, else -1


@dataclass(frozen=True, slots=True)
class Evidence:
    """What is known of a subject.

    Attributes:
        there: (N,) raw points at the place.
        fate: (N,) Fate of every raw point.
        distance: horizontal metres from the origin of the points; NaN where unknown.
        voxels: after the voxel grid.
        ground: heights above the local ground of those that are ground.
        neighbours: of the noise point that has most, within clustering.eps, itself included; 0: no noise.
        noise: voxels there that are noise.
        parts: clusters there, the one with most points first.
        in_front: returns in the subject's direction that end before it; ``aimed``: all returns there.
        front: cluster that most of those in front belong to, else -1.
        candidates: detections there, the most telling first.
        others: further objects in its main cluster: their names and points.
        gap: metres between its points and those of the nearest of these; NaN without.
        finer: largest eps that tells them apart, by clustering the points again; 0: none does.
        apart: metres between its two largest clusters, NaN without.
    """

    there: Bool
    fate: U8
    distance: float
    voxels: int
    ground: F32
    neighbours: int
    noise: int
    parts: tuple[Part, ...]
    aimed: int
    in_front: int
    front: int
    candidates: tuple[Candidate, ...]
    others: tuple[tuple[str, int], ...]
    gap: float
    finer: float
    apart: float

    @property
    def raw(self) -> int:
        return int(self.there.sum())


class Traces:
    """A frame's results with what every subject needs of them.

    Args:
        result: the frame's results.

    Attributes:
        obstacle: (M,) row of each voxel among the obstacles, -1: ground.
        cluster: (N,) of each raw point, -1: none.
        fate: (N,) of each raw point, whosever it is.
    """

    def __init__(self, result: FrameResult) -> None:
        self.result = result
        points = result.frame.points
        x, y, z = points.T
        self.azimuth, self.away = np.arctan2(y, x), np.hypot(x, y)
        self.elevation = np.arctan2(z, self.away)
        self.cluster = np.full(len(points), -1, np.int32)
        self.fate = np.full(len(points), Fate.CLUSTERED, np.uint8)
        voxels, ground, clusters = result.voxels, result.ground, result.clusters
        self.obstacle = np.zeros(0, np.int64)
        if voxels is None or ground is None:
            return
        self.obstacle = np.where(ground.mask, -1, np.cumsum(~ground.mask) - 1)
        if clusters is not None:
            of_voxel = np.full(len(ground.mask), -1, np.int32)
            of_voxel[~ground.mask] = clusters.labels
            self.cluster = of_voxel[voxels.inverse]
            named = np.zeros(len(clusters) + 1, np.bool_)  # noise, -1, is the last
            if result.objects is not None:
                named[result.objects.cluster] = True
            aside = np.append(~clusters.kept, False)
            self.fate[aside[self.cluster]] = Fate.SET_ASIDE
            self.fate[named[self.cluster]] = Fate.REPORTED
            self.fate[self.cluster < 0] = Fate.NOISE
        self.fate[ground.mask[voxels.inverse]] = Fate.GROUND


def gather(subject: Subject, traces: Traces, others: Sequence[Subject]) -> Evidence:
    """Follow the subject through the stages.

    Args:
        subject: the object.
        traces: the frame's results.
        others: all subjects of the frame, of which some may share its cluster.
    """
    result, config = traces.result, traces.result.config
    frame, voxels, clusters = result.frame, result.voxels, result.clusters
    there = subject.place(frame, frame.points)
    in_front, aimed = _before(subject, traces)
    fate = np.where(there, traces.fate, np.where(in_front, Fate.IN_FRONT, Fate.ELSEWHERE)).astype(np.uint8)
    obstacle, rows = np.zeros(0, np.int64), np.zeros(0, np.int64)
    labels, heights = np.zeros(0, np.int32), np.zeros(0, np.float32)
    if voxels is not None and result.ground is not None:
        rows = np.unique(voxels.inverse[there]).astype(np.int64)
        heights = result.ground.height[rows[traces.obstacle[rows] < 0]]
        obstacle = traces.obstacle[rows][traces.obstacle[rows] >= 0]
        labels = clusters.labels[obstacle] if clusters is not None else labels
    hiding = traces.cluster[in_front]
    front = int(np.bincount(hiding[hiding >= 0]).argmax()) if (hiding >= 0).any() else -1
    parts = _parts(labels, result)
    noise = obstacle[labels < 0]
    candidates = _candidates(subject, result, parts)
    shared = _sharing(subject, result, obstacle, parts, candidates, others, config)
    return Evidence(
        there=there,
        fate=fate,
        distance=_distance(subject, result, parts, candidates),
        voxels=len(rows),
        ground=heights,
        neighbours=_most_neighbours(result.obstacles, noise, config.clustering.eps),
        noise=len(noise),
        parts=parts,
        aimed=aimed,
        in_front=int(in_front.sum()),
        front=front,
        candidates=candidates,
        others=shared[0],
        gap=shared[1],
        finer=shared[2],
        apart=_apart(result, parts),
    )


def _parts(labels: I32, result: FrameResult) -> tuple[Part, ...]:
    found, points = np.unique(labels[labels >= 0], return_counts=True)
    clusters = result.clusters
    if clusters is None:
        return ()
    order = np.argsort(-points, kind="stable")
    return tuple(
        Part(int(k), int(n), int(clusters.count[k]), ClusterState(int(clusters.state[k])))
        for k, n in zip(found[order], points[order], strict=True)
    )


def _before(subject: Subject, traces: Traces) -> tuple[Bool, int]:
    """Returns in the subject's direction that end before it, and how many returns there are there.

    Directions are seen from the origin of the points, which for one LiDAR is the LiDAR itself.
    """
    if subject.box is None:
        return np.zeros(len(traces.away), np.bool_), 0
    corners, center = geometry.corners(subject.box)[0], subject.box.center[0]
    middle = np.arctan2(center[1], center[0])
    azimuth = _turn(np.arctan2(corners[:, 1], corners[:, 0]) - middle)
    away = np.hypot(corners[:, 0], corners[:, 1])
    elevation = np.arctan2(corners[:, 2], away)
    turned = _turn(traces.azimuth - middle)
    aimed = (turned > azimuth.min()) & (turned < azimuth.max())
    aimed &= (traces.elevation > elevation.min()) & (traces.elevation < elevation.max())
    return aimed & (traces.away < away.min() - NEARER), int(aimed.sum())


def _turn(angle: F32) -> F32:
    """The same angles within half a turn of zero."""
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi, np.float32)


def _most_neighbours(obstacles: F32 | None, noise: I64, eps: float) -> int:
    if obstacles is None or len(noise) == 0:
        return 0
    own = obstacles[noise]
    near = ((obstacles > own.min(0) - eps) & (obstacles < own.max(0) + eps)).all(axis=1)
    around = obstacles[near].astype(np.float64)
    return max(int((((around - p) ** 2).sum(1) < eps * eps).sum()) for p in own.astype(np.float64))


def _distance(
    subject: Subject, result: FrameResult, parts: Sequence[Part], candidates: Sequence[Candidate]
) -> float:
    if subject.box is not None:
        return float(np.hypot(*subject.box.center[0, :2]))
    cluster = next((c.cluster for c in candidates if c.cluster >= 0), parts[0].cluster if parts else -1)
    if cluster < 0 or result.clusters is None:
        return float("nan")
    return float(np.hypot(*result.clusters.centroid[cluster, :2]))


# --- detections --------------------------------------------------------------------------------


def _candidates(subject: Subject, result: FrameResult, parts: Sequence[Part]) -> tuple[Candidate, ...]:
    """Detections at the place: of a right class, kept, overlapping and sure ones first."""
    found = []
    for camera in result.cameras:
        detections = camera.detections
        if detections is None or (subject.camera and camera.camera.name != subject.camera):
            continue
        if subject.kind == "detection":
            # The configuration may be another one than that which the subject was found in: find it by place.
            assert subject.xyxy is not None
            overlap = geometry.iou(subject.xyxy[None], detections.xyxy)[0]
            rows = np.flatnonzero((np.array(detections.names) == subject.label) & (overlap > 0.99))
        else:
            box = subject.xyxy if subject.box is None else projected(subject.box, camera.camera)
            if box is None:
                continue
            overlap = geometry.iou(box[None], detections.xyxy)[0]
            least = 1e-6 if subject.kind in ("pixel", "point") else LINK
            rows = np.flatnonzero(overlap >= least)
        found += [_candidate(camera, int(row), float(overlap[row])) for row in rows]
    own = parts[0].cluster if parts else -2

    def rank(c: Candidate) -> tuple[bool, bool, bool, float]:
        return (
            not subject.accepts(c.name),
            c.state != DetectionState.KEPT,
            not (c.decision == Decision.MATCHED and c.cluster == own),
            -c.overlap * c.score,
        )

    return tuple(sorted(found, key=rank))


def _candidate(result: CameraResult, row: int, overlap: float) -> Candidate:
    detections, fusion = result.detections, result.fusion
    assert detections is not None
    decision, cluster = Decision.NO_CLUSTER, -1
    if fusion is not None:
        decision, cluster = Decision(int(fusion.detection_decision[row])), int(fusion.detection_cluster[row])
    return Candidate(
        result.camera.name,
        row,
        detections.names[row],
        float(detections.score[row]),
        DetectionState(int(detections.state[row])),
        overlap,
        decision,
        cluster,
    )


def fusion_of(result: FrameResult, camera: str) -> tuple[CameraResult, Fusion | None]:
    found = next(c for c in result.cameras if c.camera.name == camera)
    return found, found.fusion


# --- merged and split --------------------------------------------------------------------------


def _sharing(
    subject: Subject,
    result: FrameResult,
    own: I64,
    parts: Sequence[Part],
    candidates: Sequence[Candidate],
    others: Sequence[Subject],
    config: Config,
) -> tuple[tuple[tuple[str, int], ...], float, float]:
    """Others with points in the subject's main cluster, the gap to the nearest, and what parts them."""
    cluster = parts[0].cluster if parts else -1
    if candidates and candidates[0].decision == Decision.TAKEN and subject.kind == "detection":
        cluster = candidates[0].cluster
    if cluster < 0 or result.clusters is None or result.obstacles is None:
        return (), float("nan"), 0.0
    members = np.flatnonzero(result.clusters.labels == cluster)
    points = result.obstacles[members]
    mine = np.isin(members, own)
    found: list[tuple[str, int]] = []
    gap, nearest = float("inf"), np.zeros(len(members), np.bool_)
    for other in others:
        if other.key == subject.key or other.kind != subject.kind or not _same_view(subject, other):
            continue
        theirs = other.place(result.frame, points) & ~mine
        alone = mine if subject.box is not None else mine & ~other.place(result.frame, points)
        if theirs.sum() < max(3, SHARE * min(alone.sum(), 50)) or alone.sum() < 3:
            continue
        found.append((other.name, int(theirs.sum())))
        between = _gap(points[alone], points[theirs])
        if between < gap:
            gap, nearest = between, theirs
    if not found:
        return (), float("nan"), 0.0
    return tuple(found), gap, _finer(points, mine & ~nearest, nearest, config)


def _same_view(a: Subject, b: Subject) -> bool:
    """Whether two detections can be two objects of one image: the one is not just the other again."""
    if a.xyxy is None or b.xyxy is None:
        return True
    return a.camera == b.camera and float(geometry.iou(a.xyxy[None], b.xyxy[None])[0, 0]) < LINK


def _gap(a: F32, b: F32) -> float:
    """Least distance between two sets of points."""
    step_a, step_b = (max(1, len(p) // 2000) for p in (a, b))
    return float(np.sqrt(min(((b[::step_b] - p) ** 2).sum(1).min() for p in a[::step_a].astype(np.float64))))


def _finer(points: F32, mine: Bool, theirs: Bool, config: Config) -> float:
    """The largest eps of those tried at which most of each fall into clusters of their own."""
    for factor in FINER:
        eps = round(config.clustering.eps * factor, 3)
        labels = dbscan(points, eps, config.clustering.min_points)
        tops = []
        for part in (mine, theirs):
            known = labels[part][labels[part] >= 0]
            if len(known) < 0.5 * part.sum():
                return 0.0  # finer still only makes more of them noise
            tops.append(int(np.bincount(known).argmax()))
        if tops[0] != tops[1]:
            return eps
    return 0.0


def _apart(result: FrameResult, parts: Sequence[Part]) -> float:
    if len(parts) < 2 or result.clusters is None or result.obstacles is None:
        return float("nan")
    a, b = (result.obstacles[result.clusters.labels == part.cluster] for part in parts[:2])
    return _gap(a, b)
