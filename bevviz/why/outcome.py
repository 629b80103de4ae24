"""The reported object of a subject."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from bevviz.model import geometry
from bevviz.model.results import Decision, FrameResult, Objects
from bevviz.why.evidence import Candidate, Evidence, Named, Part, fusion_of
from bevviz.why.frame_index import FEW, PART, Traces
from bevviz.why.subject import LINK, Subject, in_box, one_of, projected

HELD = 0.3  # least share of a subject's points inside the box of its object
OVERLAP = 0.1  # or least IoU of both boxes from above


def find_named(
    subject: Subject, traces: Traces, parts: Sequence[Part], candidates: Sequence[Candidate]
) -> Named | None:
    """Find the reported object of the subject. Objects of a right class come first."""
    result = traces.result
    objects = result.objects
    if objects is None:
        return None
    if subject.kind == "object":
        rows = [subject.row] if subject.row < len(objects) else []
    elif traces.origin("objects").ours:
        rows = list(_made_of(subject, traces, parts, candidates))
    else:
        rows = list(_boxes_there(subject, traces))
    accepts = subject.accepts if traces.origin("objects").ours else subject.accepts_of_others
    rows.sort(key=lambda j: not accepts(objects.names[j]))
    for j in rows:
        return _described(subject, j, result, candidates)
    return None


def find_fused(subject: Subject, e: Evidence, traces: Traces) -> int:
    """Return the row of the object that our fusion would make of the subject, -1: none.

    It applies where the objects are not ours. A detection has its own object, other subjects that of their
    cluster.
    """
    opinions = traces.result.opinions
    if opinions is None:
        return -1
    fused = opinions.fused
    if subject.kind == "detection":
        own = {(c.camera, c.row) for c in e.candidates}
        named = zip(fused.camera, fused.detection.tolist(), strict=True)
        return next((j for j, key in enumerate(named) if key in own), -1)
    return fused.cluster.tolist().index(e.main) if e.main in fused.cluster else -1


def in_box_of(objects: Objects, row: int) -> str:
    """Name the object that is not ours and contains our fused object."""
    return f"in the box of {objects.names[row]} {objects.score[row]:.2f}"


def opinion_on(result: FrameResult, row: int) -> str:
    """Return the opinion of the cameras on an object that is not ours; empty: no opinion."""
    key = "object", row
    said = next((x.text for x in result.explanations if (x.subject, x.row) == key), "")
    return said.partition(": ")[2]


def _described(subject: Subject, j: int, result: FrameResult, candidates: Sequence[Candidate]) -> Named:
    """Return the object with the detection that named it."""
    objects = result.objects
    assert objects is not None
    camera, d, k = objects.camera[j], int(objects.detection[j]), int(objects.cluster[j])
    also: list[int] = []
    if camera:
        _, fusion = fusion_of(result, camera)
        assert fusion is not None
        same = (fusion.cluster_decision == Decision.MATCHED) & (fusion.cluster_detection == d)
        also = [other for other in np.flatnonzero(same).tolist() if other != k]
    known = subject.kind in (
        "truth",
        "detection",
    )  # The detections of a place merely touch it.
    own = any((c.camera, c.row) == (camera, d) and (known or c.overlap >= LINK) for c in candidates)
    return Named(j, objects.names[j], k, camera, d, own, tuple(also))


def _made_of(
    subject: Subject, traces: Traces, parts: Sequence[Part], candidates: Sequence[Candidate]
) -> Iterator[int]:
    """Yield the rows of the objects that come from the subject's clusters and represent it."""
    objects = traces.result.objects
    assert objects is not None
    if subject.kind == "detection":
        own = {(c.camera, c.row) for c in candidates}
        for j, key in enumerate(zip(objects.camera, objects.detection.tolist(), strict=True)):
            if key in own:
                yield j
        return
    total = len(traces.labels(subject.row)) if subject.kind == "truth" else sum(p.points for p in parts)
    least = 1 if subject.is_place else max(FEW, PART * total)
    for part in parts:
        for j in np.flatnonzero(objects.cluster == part.cluster).tolist():
            if part.points >= least and _stands_for(subject, traces, j, part):
                yield j


def _stands_for(subject: Subject, traces: Traces, j: int, part: Part) -> bool:
    """Return whether an object is this subject, and not another one in the same cluster."""
    if subject.kind != "truth":
        return True
    objects = traces.result.objects
    assert objects is not None
    camera = traces.camera(objects.camera[j])
    owner = -1 if camera is None else int(traces.owners(camera)[objects.detection[j]])
    mates = list(traces.mates(part.cluster, subject.row))
    if owner == subject.row or not mates:
        return True
    return owner not in mates and all(part.points > traces.holds(part.cluster, mate) for mate in mates)


def _boxes_there(subject: Subject, traces: Traces) -> Iterator[int]:
    """Yield the rows of the objects whose box is at the subject, for objects without clusters."""
    objects, points = traces.result.objects, traces.result.frame.points
    assert objects is not None
    if subject.kind in ("detection", "pixel"):
        camera = traces.camera(subject.camera)
        for j in range(len(objects)):
            box = projected(one_of(objects.boxes, j), camera.camera) if camera is not None else None
            if box is None or subject.xyxy is None:
                continue
            if subject.kind == "pixel" or geometry.iou(box[None], subject.xyxy[None])[0, 0] >= LINK:
                yield j
        return
    mine = points[traces.place(subject)]
    share = np.array(
        [in_box(one_of(objects.boxes, j), mine).mean() if len(mine) else 0 for j in range(len(objects))]
    )
    overlap = np.zeros(len(objects))
    if subject.box is not None and len(objects):
        overlap = geometry.bev_iou(subject.box, objects.boxes)[0]
    for j in np.argsort(-(share + overlap), kind="stable").tolist():
        if share[j] >= HELD or overlap[j] >= OVERLAP:
            yield j
