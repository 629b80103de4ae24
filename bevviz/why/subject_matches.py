"""Detections and the reported object that belong to a subject."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bevviz.model import box_overlap, geometry
from bevviz.model.frame import F32, I64
from bevviz.model.reasons import Scored, scored
from bevviz.model.results import (
    CameraResult,
    Decision,
    DetectionState,
    FrameResult,
    Fusion,
    Objects,
    texts_by_row,
)
from bevviz.why.evidence import Candidate, ClusterPart, Evidence, ReportedObject
from bevviz.why.frame_index import FEW, PART, FrameIndex
from bevviz.why.subject import LINK, Subject, points_in_box, projected_box

SURE = 0.5  # overlap from which a detection surely belongs to its object
COVERED = 0.8  # share of a cluster's image box that a detection of it covers
ONE_THING = 0.8  # IoU of two image boxes of one thing: second names have 0.9, neighbours 0.6


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
        fits = traces.fits(camera)
        for row in rows.tolist():
            own = subject.kind != "truth" or fits.belongs(row, subject.row)
            candidates.append(_candidate(camera, row, float(overlap[row]), own, int(fits.owner[row])))
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
        overlap = traces.fits(camera).overlap[:, subject.row]
        return np.flatnonzero(overlap >= LINK), overlap
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
    if fusion.matched_cluster(detection) in (-1, cluster):
        return True
    around = fusion.cluster_uv[cluster]
    low, high = np.maximum(around[:2], xyxy[:2]), np.minimum(around[2:], xyxy[2:])
    area = np.prod(around[2:] - around[:2])
    return bool(np.prod(np.maximum(high - low, 0)) >= COVERED * area)


def sort_candidates(
    candidates: Sequence[Candidate], subject: Subject, main: int, threshold: float
) -> tuple[Candidate, ...]:
    """Sort detections: own, right class, kept, matched with its cluster, surely its own, high score."""
    known = subject.kind in ("truth", "detection")

    def rank(candidate: Candidate) -> tuple[bool | float, ...]:
        """Return the sort key of a detection."""
        matched = candidate.decision == Decision.MATCHED and candidate.cluster == main
        suppressed = candidate.state == DetectionState.SUPPRESSED
        weak = candidate.score < threshold
        elsewhere = not known and candidate.decision == Decision.MATCHED and not matched
        sure = candidate.overlap * candidate.score
        return (
            not candidate.own,
            not subject.accepts(candidate.name),
            elsewhere,
            not candidate.kept,
            weak,
            suppressed and not weak,
            not matched,
            known and candidate.overlap < SURE,
            -sure,
        )

    return tuple(sorted(candidates, key=rank))


def _candidate(result: CameraResult, row: int, overlap: float, own: bool, owner: int) -> Candidate:
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
        own,
        owner,
    )


def first_name(subject: Subject, evidence: Evidence, traces: FrameIndex) -> Scored | None:
    """Return the detection that reports what a lost detection shows; None: there is none.

    Both have nearly the same image box and one cluster. A box that only lies in the other is another
    object: a person before a truck.
    """
    camera = traces.result.camera(subject.camera)
    if camera is None or camera.detections is None or camera.fusion is None or evidence.main < 0:
        return None
    detections, fusion, xyxy = camera.detections, camera.fusion, subject.xyxy
    assert xyxy is not None
    is_first = (fusion.detection_decision == Decision.MATCHED) & (fusion.detection_cluster == evidence.main)
    is_first &= geometry.iou(detections.xyxy, xyxy[None])[:, 0] >= ONE_THING
    return next(
        (scored(detections, row) for row in np.flatnonzero(is_first).tolist() if row != subject.row), None
    )


HELD = 0.3  # least share of a subject's points inside the box of its object
OVERLAP = 0.1  # or least IoU of both boxes from above


def find_reported_object(
    subject: Subject, traces: FrameIndex, parts: Sequence[ClusterPart], candidates: Sequence[Candidate]
) -> ReportedObject | None:
    """Find the reported object of the subject. Objects of a right class come first."""
    result = traces.result
    objects = result.objects
    if objects is None:
        return None
    if subject.kind == "object":
        rows = [subject.row] if subject.row < len(objects) else []
    elif traces.origin("objects").ours:
        rows = list(_objects_of_clusters(subject, traces, parts, candidates))
    else:
        rows = list(_objects_at_place(subject, traces))
    accepts = subject.accepts if traces.origin("objects").ours else subject.accepts_of_others
    rows.sort(key=lambda row: not accepts(objects.names[row]))
    if subject.kind != "truth":
        return _reported_object(subject, rows[0], traces, candidates, right=True) if rows else None
    assert traces.matches is not None
    partner = traces.matches.partner
    counted = np.flatnonzero(partner == subject.row).tolist()
    rows.sort(key=lambda row: bool(partner[row] >= 0))  # Those that count for another label come last.
    rows = [*counted, *rows]
    return _reported_object(subject, rows[0], traces, candidates, right=bool(counted)) if rows else None


def find_fused(subject: Subject, evidence: Evidence, traces: FrameIndex) -> int:
    """Return the row of the object that our fusion would make of the subject, -1: none.

    It applies where the objects are not ours. A detection has its own object, other subjects that of their
    cluster.
    """
    opinions = traces.result.opinions
    if opinions is None:
        return -1
    fused = opinions.fused
    if subject.kind == "detection":
        return next(_named_by(fused, evidence.candidates), -1)
    return fused.cluster.tolist().index(evidence.main) if evidence.main in fused.cluster else -1


def _named_by(objects: Objects, candidates: Sequence[Candidate]) -> Iterator[int]:
    """Yield the rows of the objects that some detections named."""
    keys = {(candidate.camera, candidate.row) for candidate in candidates}
    for row, key in enumerate(zip(objects.camera, objects.detection.tolist(), strict=True)):
        if key in keys:
            yield row


def opinion_on(result: FrameResult, row: int) -> str:
    """Return the opinion of the cameras on an object that is not ours; empty: no opinion."""
    return texts_by_row(result.explanations, "object").get(row, "").partition(": ")[2]


def _reported_object(
    subject: Subject, row: int, traces: FrameIndex, candidates: Sequence[Candidate], *, right: bool
) -> ReportedObject:
    """Return the object with the detection that named it."""
    result, objects = traces.result, traces.result.objects
    assert objects is not None
    camera, detection, cluster = objects.camera[row], int(objects.detection[row]), int(objects.cluster[row])
    also: list[int] = []
    if camera:
        fusion = result.fusion(camera)
        assert fusion is not None
        same = (fusion.cluster_decision == Decision.MATCHED) & (fusion.cluster_detection == detection)
        also = [other for other in np.flatnonzero(same).tolist() if other != cluster]
    known = subject.kind in ("truth", "detection")  # The detections of a place merely touch it.
    is_own = any(
        (candidate.camera, candidate.row) == (camera, detection) and (known or candidate.overlap >= LINK)
        for candidate in candidates
        if candidate.own
    )
    counts_for = -1 if traces.matches is None else int(traces.matches.partner[row])
    away = float("nan")
    if subject.box is not None:
        away = float(np.linalg.norm(objects.boxes.center[row, :2] - subject.box.center[0, :2]))
    name, others = objects.names[row], tuple(also)
    return ReportedObject(row, name, cluster, camera, detection, is_own, others, right, away, counts_for)


def _objects_of_clusters(
    subject: Subject, traces: FrameIndex, parts: Sequence[ClusterPart], candidates: Sequence[Candidate]
) -> Iterator[int]:
    """Yield the rows of the objects that come from the subject's clusters and represent it."""
    objects = traces.result.objects
    assert objects is not None
    if subject.kind == "detection":
        yield from _named_by(objects, candidates)
        return
    total = len(traces.labels(subject.row)) if subject.kind == "truth" else sum(part.points for part in parts)
    least = 1 if subject.is_place else max(FEW, PART * total)
    for part in parts:
        for row in np.flatnonzero(objects.cluster == part.cluster).tolist():
            if part.points >= least and _represents(subject, traces, row, part):
                yield row


def _represents(subject: Subject, traces: FrameIndex, row: int, part: ClusterPart) -> bool:
    """Return whether an object is this subject, and not another one in the same cluster."""
    if subject.kind != "truth":
        return True
    objects = traces.result.objects
    assert objects is not None
    owner = traces.owner_of(objects.camera[row], int(objects.detection[row]))
    mates = list(traces.mates(part.cluster, subject.row))
    if owner == subject.row or not mates:
        return True
    return owner not in mates and all(
        part.points > traces.voxels_in_cluster(part.cluster, mate) for mate in mates
    )


def _objects_at_place(subject: Subject, traces: FrameIndex) -> Iterator[int]:
    """Yield the rows of the objects whose box is at the subject, for objects without clusters."""
    objects, points = traces.result.objects, traces.result.frame.points
    assert objects is not None
    if subject.kind in ("detection", "pixel"):
        camera = traces.result.camera(subject.camera)
        for row in range(len(objects)):
            box = projected_box(objects.boxes.chosen([row]), camera.camera) if camera is not None else None
            if box is None or subject.xyxy is None:
                continue
            if subject.kind == "pixel" or geometry.iou(box[None], subject.xyxy[None])[0, 0] >= LINK:
                yield row
        return
    mine = points[traces.place(subject)]
    share = np.array(
        [
            points_in_box(objects.boxes.chosen([row]), mine).mean() if len(mine) else 0
            for row in range(len(objects))
        ]
    )
    overlap = np.zeros(len(objects))
    if subject.box is not None and len(objects):
        overlap = box_overlap.bev_iou(subject.box, objects.boxes)[0]
    for row in np.argsort(-(share + overlap), kind="stable").tolist():
        if share[row] >= HELD or overlap[row] >= OVERLAP:
            yield row
