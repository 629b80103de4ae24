"""Detections of a subject."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F32, I64
from bevviz.model.results import CameraResult, Decision, DetectionState, Fusion
from bevviz.why.evidence import Candidate, ClusterPart
from bevviz.why.frame_index import FrameIndex
from bevviz.why.subject import LINK, Subject, projected_box

COVERED = 0.8  # share of a cluster's image box that a detection of it covers


def find_candidates(
    subject: Subject, traces: FrameIndex, parts: Sequence[ClusterPart]
) -> tuple[Candidate, ...]:
    """Find the detections of the subject in all cameras."""
    candidates = []
    for camera in traces.result.cameras:
        detections = camera.detections
        if detections is None or (subject.camera and camera.camera.name != subject.camera):
            continue
        rows, overlap = _rows_of_subject(subject, traces, camera, parts)
        candidates += [_candidate(camera, int(row), float(overlap[row])) for row in rows]
    return tuple(candidates)


def _rows_of_subject(
    subject: Subject, traces: FrameIndex, camera: CameraResult, parts: Sequence[ClusterPart]
) -> tuple[I64, F32]:
    """Return the rows of the subject's detections in a camera, and the (D,) overlap with all."""
    detections = camera.detections
    assert detections is not None
    if subject.kind == "detection":
        # The subject may come from a run with another configuration, so rows differ. Find it by its box.
        assert subject.xyxy is not None
        overlap = geometry.iou(subject.xyxy[None], detections.xyxy)[0]
        return np.flatnonzero((np.array(detections.names) == subject.label) & (overlap > 0.99)), overlap
    if subject.kind == "truth":
        box = projected_box(subject.box, camera.camera) if subject.box is not None else None
        around = np.full((1, 4), np.nan, np.float32) if box is None else box[None]
        overlap = geometry.iou(around, detections.xyxy)[0]
        return np.flatnonzero(traces.owners(camera) == subject.row), overlap
    kept = [part.cluster for part in parts if part.kept]
    if not kept:
        nothing = np.zeros(len(detections), np.float32)
        if subject.xyxy is None:
            return np.zeros(0, np.int64), nothing
        overlap = geometry.iou(subject.xyxy[None], detections.xyxy)[0]
        return np.flatnonzero(overlap > 0), overlap
    return _rows_of_cluster(camera, kept[0])


def _rows_of_cluster(camera: CameraResult, cluster: int) -> tuple[I64, F32]:
    """Return the detections of a cluster: those that overlap it, and the best one of the fusion."""
    detections, fusion = camera.detections, camera.fusion
    assert detections is not None
    if fusion is None:
        return np.zeros(0, np.int64), np.zeros(len(detections), np.float32)
    overlap = geometry.iou(fusion.cluster_uv[[cluster]], detections.xyxy)[0]
    rows = np.flatnonzero(overlap >= LINK)
    best = int(fusion.cluster_detection[cluster])
    belongs = best >= 0 and _may_belong(fusion, best, cluster, detections.xyxy[best])
    return (np.union1d(rows, [best]) if belongs else rows).astype(np.int64), overlap


def _may_belong(fusion: Fusion, detection: int, cluster: int, xyxy: F32) -> bool:
    """Return whether the best detection of a cluster may belong to it.

    A detection that was matched with another cluster does not, unless it covers this one.
    """
    if (
        fusion.detection_decision[detection] != Decision.MATCHED
        or fusion.detection_cluster[detection] == cluster
    ):
        return True
    around = fusion.cluster_uv[cluster]
    low, high = np.maximum(around[:2], xyxy[:2]), np.minimum(around[2:], xyxy[2:])
    area = np.prod(around[2:] - around[:2])
    return bool(np.prod(np.maximum(high - low, 0)) >= COVERED * area)


def sort_candidates(
    candidates: Sequence[Candidate], subject: Subject, main: int, threshold: float
) -> tuple[Candidate, ...]:
    """Sort detections: right class, kept, matched with the subject's cluster, high score times overlap."""
    known = subject.kind in ("truth", "detection")

    def rank(candidate: Candidate) -> tuple[bool, bool, bool, bool, bool, bool, float]:
        """Return the sort key of a detection."""
        matched = candidate.decision == Decision.MATCHED and candidate.cluster == main
        suppressed = candidate.state == DetectionState.SUPPRESSED
        weak = candidate.score < threshold
        elsewhere = not known and candidate.decision == Decision.MATCHED and not matched
        sure = candidate.overlap * candidate.score
        return (
            not subject.accepts(candidate.name),
            elsewhere,
            not candidate.kept,
            weak,
            suppressed,
            not matched,
            -sure,
        )

    return tuple(sorted(candidates, key=rank))


def _candidate(result: CameraResult, row: int, overlap: float) -> Candidate:
    """Return a detection with the decisions about it."""
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
