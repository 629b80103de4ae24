"""Findings in a frame: missed objects, false objects, and unexplained detections and clusters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bevviz.evaluate import RANGE, Truth, match
from bevviz.model import geometry
from bevviz.model.frame import F32, F64
from bevviz.model.results import Decision, FrameResult, Opinion
from bevviz.why import Questioner, Selection
from bevviz.why.pick import Pick

FEW = 30  # points. A smaller cluster without a detection is probably no object of a known class.

Place = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Find:
    """One finding.

    Attributes:
        frame: number of the scan.
        stamp: stamp of the scan, in nanoseconds.
        what: missed, false, contradicted, lost, unmatched or unnamed.
        name: name of the class, or "cluster".
        distance: horizontal distance in metres. NaN: unknown.
        pick: pick that asks about it.
        reason: short reason.
        place: position in the fixed frame, if known.
        box: (4,) box in the image, for a detection without position.
    """

    frame: int
    stamp: int
    what: str
    name: str
    distance: float
    pick: Pick
    reason: str = ""
    place: Place | None = None
    box: F32 | None = None


def finds(result: FrameResult, truth: Truth | None) -> list[Find]:
    """Return the findings of a frame within 40 m, nearest first.

    With ground truth these are missed and false objects. Without it they are:

    - objects of another perception that a camera contradicts,
    - objects that it has lost and our fusion has,
    - kept detections without a cluster,
    - clusters in view without a detection.
    """
    found = list(_judged(result, truth) if truth is not None else [*_doubted(result), *_unexplained(result)])
    near = [find for find in found if not find.distance > RANGE]
    return sorted(near, key=lambda find: (find.what == "false", np.nan_to_num(find.distance, nan=RANGE)))


def with_reasons(found: Sequence[Find], result: FrameResult, questioner: Questioner) -> list[Find]:
    """Return the findings with the reason of the verdict at each missed object."""
    reasons = {}
    for find in found:
        if find.what == "missed":
            answers = questioner.ask(Selection(truth=find.pick.row))
            reasons[find.pick] = answers[0].verdict.reason.value if answers else ""
    return [replace(find, reason=reasons.get(find.pick, find.reason)) for find in found]


def _judged(result: FrameResult, truth: Truth) -> Iterator[Find]:
    """Yield the false and the missed objects by ground truth."""
    when, objects, pose = (result.frame.index, result.frame.stamp), result.objects, result.frame.pose
    free = truth.must.copy()
    if objects is not None and len(objects):
        partner, _ = match(objects, truth)
        free[partner[partner >= 0]] = False
        judged = frozenset().union(*truth.accepted)
        for row in np.flatnonzero(partner < 0).tolist():
            name, center = objects.names[row], objects.boxes.center[row]
            if name.lower() in judged:
                away = float(np.hypot(*center[:2]))
                yield Find(*when, "false", name, away, Pick("object", row), place=fixed_place(pose, center))
    for row in np.flatnonzero(free).tolist():
        center = truth.boxes.center[row]
        name, away = truth.labels[row].lower(), float(np.hypot(*center[:2]))
        yield Find(*when, "missed", name, away, Pick("truth", row), place=fixed_place(pose, center))


def _doubted(result: FrameResult) -> Iterator[Find]:
    """Yield the findings about objects of another perception: contradicted by a camera, or lost."""
    opinions, objects = result.opinions, result.objects
    if opinions is None or objects is None:
        return
    when, pose, fused = (result.frame.index, result.frame.stamp), result.frame.pose, opinions.fused
    for row in np.flatnonzero(opinions.opinion == Opinion.CONTRADICTED).tolist():
        center, pick = objects.boxes.center[row], Pick("object", row)
        away, reason = float(np.hypot(*center[:2])), f"by {opinions.camera[row]}"
        yield Find(*when, "contradicted", objects.names[row], away, pick, reason, fixed_place(pose, center))
    for row in np.flatnonzero(opinions.missed).tolist():
        center, camera = fused.boxes.center[row], fused.camera[row]
        pick = Pick("detection", int(fused.detection[row]), camera)
        away, reason = float(np.hypot(*center[:2])), f"{fused.score[row]:.2f} in {camera}"
        yield Find(*when, "lost", fused.names[row], away, pick, reason, fixed_place(pose, center))


def _unexplained(result: FrameResult) -> Iterator[Find]:
    """Yield the detections without a cluster and the clusters without a detection."""
    when, clusters, pose = (result.frame.index, result.frame.stamp), result.clusters, result.frame.pose
    named = np.zeros(0 if clusters is None else len(clusters), bool)
    seen = named.copy()
    for camera in result.cameras:
        detections, fusion = camera.detections, camera.fusion
        if detections is None or fusion is None:
            continue
        named |= fusion.cluster_decision == Decision.MATCHED
        seen |= fusion.cluster_decision == Decision.NO_DETECTION
        for row in np.flatnonzero(detections.kept & (fusion.detection_decision != Decision.MATCHED)).tolist():
            reason = Decision(int(fusion.detection_decision[row])).name.lower().replace("_", " ")
            away, name, place = float("nan"), detections.names[row], None
            if (cluster := int(fusion.detection_cluster[row])) >= 0 and clusters is not None:
                away = float(np.hypot(*clusters.centroid[cluster, :2]))
                place = fixed_place(pose, clusters.centroid[cluster])
            pick = Pick("detection", row, camera.camera.name)
            yield Find(*when, "unmatched", name, away, pick, reason, place, detections.xyxy[row])
    if clusters is None:
        return
    for row in np.flatnonzero(seen & ~named & clusters.kept & (clusters.count >= FEW)).tolist():
        center = clusters.centroid[row]
        away, reason = float(np.hypot(*center[:2])), f"{clusters.count[row]} points, no detection"
        yield Find(*when, "unnamed", "cluster", away, Pick("cluster", row), reason, fixed_place(pose, center))


def fixed_place(pose: F64, center: F32) -> Place:
    """Return a point in the fixed frame."""
    x, y, z = geometry.apply(pose, np.asarray(center, np.float32)[None])[0].tolist()
    return x, y, z
