"""Other objects in a subject's cluster, their distance, and the eps that separates them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F32, I32, Bool
from bevviz.model.reasons import Scored
from bevviz.stages.clustering import dbscan
from bevviz.support.numba_kernel import kernel
from bevviz.why.evidence import MOST
from bevviz.why.frame_index import FEW, PART, FrameIndex
from bevviz.why.subject import LINK, Subject

FINER = (0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2)  # factors on clustering.eps to separate merged objects
LOOKED_AT = 2000  # points of a large set used for distances


def find_mates(subject: Subject, traces: FrameIndex, main: int) -> list[tuple[Subject, int]]:
    """Return the other objects in the subject's main cluster, with their numbers of points there."""
    clusters = traces.result.clusters
    if main < 0 or clusters is None:
        return []
    if subject.kind == "truth":
        rows = traces.mates(main, subject.row)
        return [(traces.truth[row], traces.voxels_in_cluster(main, row)) for row in rows]
    if subject.kind != "detection":
        return []
    members = np.flatnonzero(clusters.labels == main)
    mine = traces.obstacles_of(subject)[members]
    mates = []
    for other in traces.competing:
        if other.key == subject.key or not _same_view(subject, other):
            continue
        theirs = traces.obstacles_of(other)[members]
        alone, apart = mine & ~theirs, theirs & ~mine
        if alone.sum() >= FEW and apart.sum() >= max(FEW, PART * min(int(alone.sum()), 50)):
            mates.append((other, int(theirs.sum())))
    return mates


def _same_view(a: Subject, b: Subject) -> bool:
    """Return whether two detections can be two objects of one image, and not one object detected twice."""
    if a.xyxy is None or b.xyxy is None:
        return True
    return a.camera == b.camera and float(geometry.iou(a.xyxy[None], b.xyxy[None])[0, 0]) < LINK


def separation(
    subject: Subject, traces: FrameIndex, main: int, mates: Sequence[tuple[Subject, int]]
) -> tuple[float, float, Scored | None]:
    """Return the gap in metres between the subject and its mates, the eps that parts them, and the joiner.

    The gap is NaN if the cluster holds only the subject. The eps is 0 if none separates them. The joiner is
    the detection for which the fusion joined clusters that the clustering had kept apart.
    """
    result = traces.result
    clusters, obstacles = result.clusters, result.obstacles
    if main < 0 or clusters is None or obstacles is None or subject.kind not in ("truth", "detection"):
        return float("nan"), 0.0, None
    members = np.flatnonzero(clusters.labels == main)
    mine = traces.obstacles_of(subject)[members]
    if not mates and (subject.kind == "detection" or mine.mean() >= MOST):
        return float("nan"), 0.0, None
    points = obstacles[members]
    nearest, gap = ~mine, float("inf")
    for other, _ in mates:
        theirs = traces.obstacles_of(other)[members]
        theirs &= ~mine if subject.box is not None else np.True_
        alone = mine if subject.box is not None else mine & ~theirs
        if alone.any() and theirs.any():
            between = least_distance(points[alone], points[theirs])
            if between < gap:
                gap, nearest = between, theirs
    mine &= ~nearest
    if not mine.any() or not nearest.any():
        return float("nan"), 0.0, None
    if not mates:
        gap = least_distance(points[mine], points[nearest])
    first = traces.first_labels[members]
    joined_by, label = None, _most_frequent(first[mine])
    if label < 0 or label != _most_frequent(first[nearest]):  # The clustering itself left noise alone.
        joined_by = _joining_detection(traces, main)
    ours = traces.origin("clustering").ours and joined_by is None
    return gap, _separating_eps(points, mine, nearest, traces) if ours else 0.0, joined_by


def _most_frequent(labels: I32) -> int:
    """Return the label that occurs most often."""
    values, counts = np.unique(labels, return_counts=True)
    return int(values[counts.argmax()])


def _joining_detection(traces: FrameIndex, cluster: int) -> Scored | None:
    """Return the detection for which the fusion made a cluster."""
    splits = traces.result.splits
    rows = [] if splits is None else np.flatnonzero(splits.cluster == cluster).tolist()
    if splits is None or not rows:
        return None
    return traces.scored(splits.camera[rows[0]], int(splits.detection[rows[0]]))


def _separating_eps(points: F32, mine: Bool, theirs: Bool, traces: FrameIndex) -> float:
    """Return the largest tried eps at which the two sets of points fall into different clusters."""
    config = traces.result.config.clustering
    for factor in FINER:
        eps = round(config.eps * factor, 3)
        labels = dbscan(points, eps, config.min_points)
        tops = []
        for part in (mine, theirs):
            known = labels[part][labels[part] >= 0]
            if len(known) < 0.5 * part.sum():
                return 0.0  # A smaller eps only turns more of them into noise.
            tops.append(int(np.bincount(known).argmax()))
        if tops[0] != tops[1]:
            return eps
    return 0.0


def least_distance(a: F32, b: F32) -> float:
    """Return the least distance between two sets of points; approximate for large sets."""
    return float(np.sqrt(_closest(a[:: 1 + len(a) // LOOKED_AT], b[:: 1 + len(b) // LOOKED_AT])))


@kernel
def _closest(a: F32, b: F32) -> float:
    """Return the square of the least distance."""
    least = np.inf
    for i in range(len(a)):
        for j in range(len(b)):
            square = 0.0
            for axis in range(3):
                square += (np.float64(a[i, axis]) - b[j, axis]) ** 2
            least = min(least, square)
    return least
