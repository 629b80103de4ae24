"""What else is in a subject's cluster, how far from it, and what would part the two."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F32, I64, Bool
from bevviz.stages.clustering import dbscan
from bevviz.support.kernel import kernel
from bevviz.why.evidence import MOST
from bevviz.why.frame_index import FEW, PART, Traces
from bevviz.why.subject import LINK, Subject

FINER = (0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2)  # of clustering.eps, tried to tell merged objects apart
LOOKED_AT = 2000  # points of a large set of which distances are measured


def find_mates(subject: Subject, traces: Traces, main: int, own: I64) -> list[tuple[int, str, int]]:
    """Row, name and points of others in the subject's main cluster."""
    clusters, obstacles = traces.result.clusters, traces.result.obstacles
    if main < 0 or clusters is None or obstacles is None:
        return []
    if subject.kind == "truth":
        rows = traces.mates(main, subject.row)
        return [(row, traces.truth[row].name, traces.holds(main, row)) for row in rows]
    if subject.kind != "detection":
        return []
    members = np.flatnonzero(clusters.labels == main)
    mine = np.isin(members, own)
    found = []
    for other in traces.competing:
        if other.key == subject.key or not _same_view(subject, other):
            continue
        voxels = traces.result.voxels
        assert voxels is not None
        rows_of = traces.obstacle[np.unique(voxels.inverse[traces.place(other)])]
        theirs = np.isin(members, rows_of)
        alone, apart = mine & ~theirs, theirs & ~mine
        if alone.sum() >= FEW and apart.sum() >= max(FEW, PART * min(int(alone.sum()), 50)):
            found.append((other.row, other.name, int(theirs.sum())))
    return found


def _same_view(a: Subject, b: Subject) -> bool:
    """Whether two detections can be two objects of one image: the one is not just the other again."""
    if a.xyxy is None or b.xyxy is None:
        return True
    return a.camera == b.camera and float(geometry.iou(a.xyxy[None], b.xyxy[None])[0, 0]) < LINK


def part_from(
    subject: Subject, traces: Traces, main: int, own: I64, mates: Sequence[tuple[int, str, int]]
) -> tuple[float, float]:
    """The gap between the subject and what else is in its cluster, and the eps that parts them."""
    result = traces.result
    clusters, obstacles = result.clusters, result.obstacles
    if main < 0 or clusters is None or obstacles is None or subject.kind not in ("truth", "detection"):
        return float("nan"), 0.0
    members = np.flatnonzero(clusters.labels == main)
    mine = np.isin(members, own)
    if not mates and (subject.kind == "detection" or mine.mean() >= MOST):
        return float("nan"), 0.0
    points = obstacles[members]
    nearest, gap = ~mine, float("inf")
    voxels = result.voxels
    assert voxels is not None
    for row, _, _ in mates:
        other = traces.truth[row] if subject.kind == "truth" else _other(traces, subject.camera, row)
        theirs = np.isin(members, traces.obstacle[np.unique(voxels.inverse[traces.place(other)])])
        theirs &= ~mine if subject.box is not None else np.True_
        alone = mine if subject.box is not None else mine & ~theirs
        if alone.any() and theirs.any():
            between = closest(points[alone], points[theirs])
            if between < gap:
                gap, nearest = between, theirs
    mine &= ~nearest
    if not mine.any() or not nearest.any():
        return float("nan"), 0.0
    if not mates:
        gap = closest(points[mine], points[nearest])
    finer = _finer(points, mine, nearest, traces) if traces.origin("clustering").ours else 0.0
    return gap, finer


def _other(traces: Traces, camera: str, row: int) -> Subject:
    return next(s for s in traces.competing if (s.camera, s.row) == (camera, row))


def _finer(points: F32, mine: Bool, theirs: Bool, traces: Traces) -> float:
    """The largest eps of those tried at which most of each fall into clusters of their own."""
    config = traces.result.config.clustering
    for factor in FINER:
        eps = round(config.eps * factor, 3)
        labels = dbscan(points, eps, config.min_points)
        tops = []
        for part in (mine, theirs):
            known = labels[part][labels[part] >= 0]
            if len(known) < 0.5 * part.sum():
                return 0.0  # finer still only makes more of them noise
            tops.append(int(np.bincount(known).argmax()))
        if tops[0] != tops[1]:
            return eps
    return 0.0


def closest(a: F32, b: F32) -> float:
    """Least distance between two sets of points, of large ones roughly."""
    return float(np.sqrt(_closest(a[:: 1 + len(a) // LOOKED_AT], b[:: 1 + len(b) // LOOKED_AT])))


@kernel
def _closest(a: F32, b: F32) -> float:
    """Square of the least distance."""
    least = np.inf
    for i in range(len(a)):
        for j in range(len(b)):
            square = 0.0
            for axis in range(3):
                square += (np.float64(a[i, axis]) - b[j, axis]) ** 2
            least = min(least, square)
    return least
