"""The reported object of a subject."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bevviz.model import geometry
from bevviz.model.results import Decision, FrameResult, Objects
from bevviz.why.evidence import Candidate, ClusterPart, Evidence, ReportedObject, camera_and_fusion
from bevviz.why.frame_index import FEW, PART, FrameIndex
from bevviz.why.subject import LINK, Subject, points_in_box, projected_box, single_box

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
    for row in rows:
        return _reported_object(subject, row, result, candidates)
    return None


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
        candidate_keys = {(candidate.camera, candidate.row) for candidate in evidence.candidates}
        named = zip(fused.camera, fused.detection.tolist(), strict=True)
        return next((row for row, key in enumerate(named) if key in candidate_keys), -1)
    return fused.cluster.tolist().index(evidence.main) if evidence.main in fused.cluster else -1


def in_box_of(objects: Objects, row: int) -> str:
    """Name the object that is not ours and contains our fused object."""
    return f"in the box of {objects.names[row]} {objects.score[row]:.2f}"


def opinion_on(result: FrameResult, row: int) -> str:
    """Return the opinion of the cameras on an object that is not ours; empty: no opinion."""
    key = "object", row
    text = next(
        (
            explanation.text
            for explanation in result.explanations
            if (explanation.subject, explanation.row) == key
        ),
        "",
    )
    return text.partition(": ")[2]


def _reported_object(
    subject: Subject, row: int, result: FrameResult, candidates: Sequence[Candidate]
) -> ReportedObject:
    """Return the object with the detection that named it."""
    objects = result.objects
    assert objects is not None
    camera, detection, cluster = objects.camera[row], int(objects.detection[row]), int(objects.cluster[row])
    also: list[int] = []
    if camera:
        _, fusion = camera_and_fusion(result, camera)
        assert fusion is not None
        same = (fusion.cluster_decision == Decision.MATCHED) & (fusion.cluster_detection == detection)
        also = [other for other in np.flatnonzero(same).tolist() if other != cluster]
    known = subject.kind in (
        "truth",
        "detection",
    )  # The detections of a place merely touch it.
    is_own = any(
        (candidate.camera, candidate.row) == (camera, detection) and (known or candidate.overlap >= LINK)
        for candidate in candidates
    )
    return ReportedObject(row, objects.names[row], cluster, camera, detection, is_own, tuple(also))


def _objects_of_clusters(
    subject: Subject, traces: FrameIndex, parts: Sequence[ClusterPart], candidates: Sequence[Candidate]
) -> Iterator[int]:
    """Yield the rows of the objects that come from the subject's clusters and represent it."""
    objects = traces.result.objects
    assert objects is not None
    if subject.kind == "detection":
        candidate_keys = {(candidate.camera, candidate.row) for candidate in candidates}
        for row, key in enumerate(zip(objects.camera, objects.detection.tolist(), strict=True)):
            if key in candidate_keys:
                yield row
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
    camera = traces.camera(objects.camera[row])
    owner = -1 if camera is None else int(traces.owners(camera)[objects.detection[row]])
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
        camera = traces.camera(subject.camera)
        for row in range(len(objects)):
            box = projected_box(single_box(objects.boxes, row), camera.camera) if camera is not None else None
            if box is None or subject.xyxy is None:
                continue
            if subject.kind == "pixel" or geometry.iou(box[None], subject.xyxy[None])[0, 0] >= LINK:
                yield row
        return
    mine = points[traces.place(subject)]
    share = np.array(
        [
            points_in_box(single_box(objects.boxes, row), mine).mean() if len(mine) else 0
            for row in range(len(objects))
        ]
    )
    overlap = np.zeros(len(objects))
    if subject.box is not None and len(objects):
        overlap = geometry.bev_iou(subject.box, objects.boxes)[0]
    for row in np.argsort(-(share + overlap), kind="stable").tolist():
        if share[row] >= HELD or overlap[row] >= OVERLAP:
            yield row
