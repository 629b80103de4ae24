"""The cause of a false object: one that no ground truth explains or, without ground truth, a doubtful one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from bevviz.evaluate import MAX_DISTANCE
from bevviz.model import box_overlap, geometry
from bevviz.model.reasons import Reason, ReasonKind, scored
from bevviz.model.results import Objects
from bevviz.why.evidence import MOST
from bevviz.why.frame_index import FrameIndex, detection_subject
from bevviz.why.reason_text import WITHIN
from bevviz.why.subject import MARGIN, points_in_box
from bevviz.why.subject_matches import opinion_on

LARGER = 1.5  # a cluster that is this many times as long as the object's box is no such object
BARELY = 2.0  # factor on a limit of the fusion within which it accepts an object only just
DOUBLE = 0.1  # IoU from above from which two objects are one
INSIDE = 0.6  # share of an object's box in a labelled one from which it is a part of that object
DEPTH = 3.0  # metres that an object may be nearer than the points in the middle of its 2D box


def false_reasons(traces: FrameIndex) -> Mapping[int, Reason]:
    """Return object row -> cause, for the objects that ``evaluate`` calls false.

    Without ground truth these are the doubtful objects of our fusion.
    """
    if traces.false is None:
        traces.false = dict(_false_reasons(traces))
    return traces.false


def _false_reasons(traces: FrameIndex) -> Iterator[tuple[int, Reason]]:
    """Yield the false objects with their causes."""
    objects, matches = traces.result.objects, traces.matches
    if objects is None:
        return
    if matches is None or not traces.is_labelled:
        for row in range(len(objects)) if traces.origin("objects").ours else ():
            if (doubt := _doubt(traces, objects, row)) is not None:
                yield row, doubt
        return
    for row in np.flatnonzero(matches.false).tolist():
        yield row, _cause(traces, objects, row)


def _cause(traces: FrameIndex, objects: Objects, row: int) -> Reason:
    """Return the cause of an object that no ground truth explains."""
    assert traces.matches is not None
    name, partner = objects.names[row], traces.matches.partner
    owner = traces.owner_of(objects.camera[row], int(objects.detection[row]))
    holder = _holder_of_points(traces, objects, row)
    inside = _label_around(traces, objects, row)
    for number in dict.fromkeys((holder, owner, inside)):
        if number < 0:
            continue
        subject = traces.truth[number]
        assert subject.box is not None
        away = float(np.linalg.norm(objects.boxes.center[row, :2] - subject.box.center[0, :2]))
        other = np.flatnonzero(partner == number)
        if len(other) and (number in (holder, inside) or away <= MAX_DISTANCE):
            first = scored(objects, int(other[0]))
            if number == inside:
                whole = f"it is inside the box of {subject.name}"
                text = f"{whole}: a second box of it, which {first} is already"
            else:
                text = f"it is a duplicate: {subject.name} is {first} already"
            if away <= MAX_DISTANCE or number in (owner, inside):
                return Reason(ReasonKind.DUPLICATE, text=text)
            text = f"its points are a part of {subject.name}, which {first} is already"
            return Reason(ReasonKind.SPLIT, text=text)
        if number in (holder, inside) and not subject.accepts(name):
            return Reason(ReasonKind.MISNAMED, text=f"its points are those of {subject.name}")
        if number in (holder, inside):
            text = f"its points are those of {subject.name}, {away:.1f} m from it ({WITHIN})"
            return Reason(ReasonKind.MISPLACED, text=text)
    size = _larger_whole(traces, objects, row)
    if owner >= 0:
        truth = traces.truth[owner]
        assert truth.box is not None
        side = _side(float(objects.boxes.distance[row] - truth.box.distance[0]))
        if size is not None:
            return _wall(objects, row, size, f", {side} {truth.name}")
        text = f"its 2D box is that of {truth.name}, and its cluster {objects.cluster[row]} is {side} it"
        return Reason(ReasonKind.WRONG_DEPTH, text=text)
    if size is not None:
        return _wall(objects, row, size)
    text = "no label is in reach: it is unlabelled, or the detector's own error"
    opinion = "" if traces.origin("objects").ours else opinion_on(traces.result, row)
    return Reason(ReasonKind.DETECTOR_ERROR, text=f"{text}, and it is {opinion}" if opinion else text)


def _side(off: float) -> str:
    """Say how far an object is before or behind the thing of its 2D box."""
    return f"{abs(off):.1f} m {'behind' if off > 0 else 'before'}"


def _wall(objects: Objects, row: int, size: tuple[float, float], where: str = "") -> Reason:
    """Return the reason for an object that is a part of something of this length and height."""
    larger = f"something {size[0]:.1f} m long and {size[1]:.1f} m high in the frustum{where}"
    text = f"its points (cluster {objects.cluster[row]}) are a part of {larger}"
    return Reason(ReasonKind.WALL, text=text)


def _doubt(traces: FrameIndex, objects: Objects, row: int) -> Reason | None:
    """Return what makes an object doubtful, None if nothing does."""
    better = np.flatnonzero(objects.score > objects.score[row])
    better = better[[objects.names[other] == objects.names[row] for other in better]]
    overlap = box_overlap.bev_iou(objects.boxes.chosen([row]), objects.boxes)[0]
    doubles = better[overlap[better] >= DOUBLE]
    if len(doubles):
        other = scored(objects, int(doubles[overlap[doubles].argmax()]))
        return Reason(ReasonKind.DUPLICATE, text=f"it is a duplicate: its box overlaps that of {other}")
    size = _larger_whole(traces, objects, row)
    if size is not None and _is_barely_accepted(traces, objects, row):
        return _wall(objects, row, size)
    off = _off_its_box(traces, objects, row)
    if off < -DEPTH:  # A right object may be behind the points that hide its middle.
        middle = "the points in the middle of its 2D box"
        text = f"its cluster {objects.cluster[row]} is {_side(off)} {middle}"
        return Reason(ReasonKind.WRONG_DEPTH, text=text)
    return None


def _holder_of_points(traces: FrameIndex, objects: Objects, row: int) -> int:
    """Return the row of the ground truth object that holds most points of an object, -1: none."""
    points, cluster = traces.result.frame.points, int(objects.cluster[row])
    has_cluster = cluster >= 0 and traces.origin("objects").ours
    is_own = traces.cluster == cluster if has_cluster else geometry.inside(points, objects.boxes, row)
    points, truth = points[is_own], traces.labels_in_evaluate
    if truth is None or not len(points):
        return -1
    center, reach = truth.boxes.center[:, :2], np.hypot(*truth.boxes.size[:, :2].T)[:, None] / 2 + MARGIN
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    near = np.flatnonzero(((center + reach >= low) & (center - reach <= high)).all(axis=1)).tolist()
    shares = {k: float(points_in_box(truth.boxes.chosen([k]), points).mean()) for k in near}
    holder = max(shares, key=lambda k: shares[k], default=-1)
    return holder if holder >= 0 and shares[holder] >= MOST else -1


def _label_around(traces: FrameIndex, objects: Objects, row: int) -> int:
    """Return the row of the ground truth object whose box holds most of an object's, -1: none."""
    truth = traces.labels_in_evaluate
    if truth is None or not len(truth.boxes):
        return -1
    box = objects.boxes.chosen([row])
    is_larger = np.prod(truth.boxes.size[:, :2], axis=1) >= np.prod(box.size[:, :2])
    shares = np.where(is_larger, box_overlap.bev_iou_and_share(box, truth.boxes)[1][0], 0)
    return int(shares.argmax()) if shares.max() >= INSIDE else -1


def _larger_whole(traces: FrameIndex, objects: Objects, row: int) -> tuple[float, float] | None:
    """Return length and height of what an object's points are a part of, None if it is not larger.

    The clustering itself is asked, since a detection may have cut the points out of its cluster.
    """
    clusters, obstacles = traces.result.clusters, traces.result.obstacles
    if clusters is None or obstacles is None or objects.cluster[row] < 0:
        return None
    first = traces.first_labels[clusters.labels == objects.cluster[row]]
    first = first[first >= 0]
    if not len(first):
        return None
    whole = obstacles[traces.first_labels == np.bincount(first).argmax()]
    extent = np.ptp(whole, axis=0)
    length, height = float(np.hypot(*extent[:2])), float(extent[2])
    size = objects.boxes.size[row]
    is_larger = length > LARGER * float(np.hypot(*size[:2])) or height > LARGER * max(float(size[2]), 1.0)
    return (length, height) if is_larger else None


def _is_barely_accepted(traces: FrameIndex, objects: Objects, row: int) -> bool:
    """Return whether a limit of the fusion only just accepted the points of an object.

    Right objects are cut out of larger clusters, too, but suit their detections better.
    """
    fusion, detection = traces.result.fusion(objects.camera[row]), int(objects.detection[row])
    config = traces.result.config.fusion
    if fusion is None:
        return False
    if fusion.claims is not None:
        return bool(fusion.claims.fit[detection] * objects.score[row] < BARELY * config.min_rating)
    pair = fusion.pair(detection, int(objects.cluster[row]))
    return pair is not None and pair.iou < BARELY * config.min_iou


def _off_its_box(traces: FrameIndex, objects: Objects, row: int) -> float:
    """Return the metres by which an object is behind the points in the middle of its 2D box."""
    camera, detection = traces.result.camera(objects.camera[row]), int(objects.detection[row])
    if camera is None or (fusion := camera.fusion) is None or detection < 0:
        return 0.0
    view = camera.camera
    if view.camera_from_points is None or fusion.matched_cluster(detection) < 0:
        return 0.0
    pair = fusion.pair(detection, int(objects.cluster[row]))
    points = traces.place(detection_subject(traces.result, camera, detection))
    if pair is None or not len(points):
        return 0.0
    depth = geometry.apply(view.camera_from_points, traces.result.frame.points[points])[:, 2]
    return pair.depth - float(np.median(depth))
