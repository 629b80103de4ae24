"""Findings in a frame: missed objects, false objects, and unexplained detections and clusters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bevviz.evaluate import RANGE, Truth, match
from bevviz.model import geometry
from bevviz.model.frame import F32, F64
from bevviz.model.results import Decision, FrameResult, Opinion
from bevviz.why import FrameExplainer, Selection
from bevviz.why.pick import Pick

FEW = 30  # points. A smaller cluster without a detection is probably no object of a known class.

Position = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding.

    Attributes:
        frame: number of the scan.
        stamp: stamp of the scan, in nanoseconds.
        what: missed, false, contradicted, lost, unmatched or unnamed.
        name: name of the class, or "cluster".
        distance: horizontal distance in metres. NaN: unknown.
        pick: pick that asks about it.
        reason: short reason.
        position: position in the fixed frame, if known.
        box: (4,) box in the image, for a detection without position.
    """

    frame: int
    stamp: int
    what: str
    name: str
    distance: float
    pick: Pick
    reason: str = ""
    position: Position | None = None
    box: F32 | None = None


def find_findings(result: FrameResult, truth: Truth | None) -> list[Finding]:
    """Return the findings of a frame within 40 m, nearest first.

    With ground truth these are missed and false objects. Without it they are:

    - objects of another perception that a camera contradicts,
    - objects that it has lost and our fusion has,
    - kept detections without a cluster,
    - clusters in view without a detection.
    """
    findings = list(
        _judged(result, truth) if truth is not None else [*_doubted(result), *_unexplained(result)]
    )
    near_findings = [finding for finding in findings if not finding.distance > RANGE]
    return sorted(
        near_findings,
        key=lambda finding: (finding.what == "false", np.nan_to_num(finding.distance, nan=RANGE)),
    )


def with_reasons(
    findings: Sequence[Finding], result: FrameResult, questioner: FrameExplainer
) -> list[Finding]:
    """Return the findings with the reason of the verdict at each missed object."""
    reasons = {}
    for finding in findings:
        if finding.what == "missed":
            answers = questioner.ask(Selection(truth=finding.pick.row))
            reasons[finding.pick] = answers[0].verdict.reason.value if answers else ""
    return [replace(finding, reason=reasons.get(finding.pick, finding.reason)) for finding in findings]


def _judged(result: FrameResult, truth: Truth) -> Iterator[Finding]:
    """Yield the false and the missed objects by ground truth."""
    frame_ids, objects, pose = (result.frame.index, result.frame.stamp), result.objects, result.frame.pose
    unmatched = truth.must.copy()
    if objects is not None and len(objects):
        partner, _ = match(objects, truth)
        unmatched[partner[partner >= 0]] = False
        judged = frozenset().union(*truth.accepted)
        for row in np.flatnonzero(partner < 0).tolist():
            name, center = objects.names[row], objects.boxes.center[row]
            if name.lower() in judged:
                distance = float(np.hypot(*center[:2]))
                yield Finding(
                    *frame_ids,
                    "false",
                    name,
                    distance,
                    Pick("object", row),
                    position=fixed_position(pose, center),
                )
    for row in np.flatnonzero(unmatched).tolist():
        center = truth.boxes.center[row]
        name, distance = truth.labels[row].lower(), float(np.hypot(*center[:2]))
        yield Finding(
            *frame_ids, "missed", name, distance, Pick("truth", row), position=fixed_position(pose, center)
        )


def _doubted(result: FrameResult) -> Iterator[Finding]:
    """Yield the findings about objects of another perception: contradicted by a camera, or lost."""
    opinions, objects = result.opinions, result.objects
    if opinions is None or objects is None:
        return
    frame_ids, pose, fused = (result.frame.index, result.frame.stamp), result.frame.pose, opinions.fused
    for row in np.flatnonzero(opinions.opinion == Opinion.CONTRADICTED).tolist():
        center, pick = objects.boxes.center[row], Pick("object", row)
        distance, reason = float(np.hypot(*center[:2])), f"by {opinions.camera[row]}"
        yield Finding(
            *frame_ids,
            "contradicted",
            objects.names[row],
            distance,
            pick,
            reason,
            fixed_position(pose, center),
        )
    for row in np.flatnonzero(opinions.missed).tolist():
        center, camera = fused.boxes.center[row], fused.camera[row]
        pick = Pick("detection", int(fused.detection[row]), camera)
        distance, reason = float(np.hypot(*center[:2])), f"{fused.score[row]:.2f} in {camera}"
        yield Finding(
            *frame_ids, "lost", fused.names[row], distance, pick, reason, fixed_position(pose, center)
        )


def _unexplained(result: FrameResult) -> Iterator[Finding]:
    """Yield the detections without a cluster and the clusters without a detection."""
    frame_ids, clusters, pose = (result.frame.index, result.frame.stamp), result.clusters, result.frame.pose
    named = np.zeros(0 if clusters is None else len(clusters), bool)
    in_view = named.copy()
    for camera in result.cameras:
        detections, fusion = camera.detections, camera.fusion
        if detections is None or fusion is None:
            continue
        named |= fusion.cluster_decision == Decision.MATCHED
        in_view |= fusion.cluster_decision == Decision.NO_DETECTION
        for row in np.flatnonzero(detections.kept & (fusion.detection_decision != Decision.MATCHED)).tolist():
            reason = Decision(int(fusion.detection_decision[row])).name.lower().replace("_", " ")
            distance, name, position = float("nan"), detections.names[row], None
            if (cluster := int(fusion.detection_cluster[row])) >= 0 and clusters is not None:
                distance = float(np.hypot(*clusters.centroid[cluster, :2]))
                position = fixed_position(pose, clusters.centroid[cluster])
            pick = Pick("detection", row, camera.camera.name)
            yield Finding(
                *frame_ids, "unmatched", name, distance, pick, reason, position, detections.xyxy[row]
            )
    if clusters is None:
        return
    for row in np.flatnonzero(in_view & ~named & clusters.kept & (clusters.count >= FEW)).tolist():
        center = clusters.centroid[row]
        distance, reason = float(np.hypot(*center[:2])), f"{clusters.count[row]} points, no detection"
        yield Finding(
            *frame_ids,
            "unnamed",
            "cluster",
            distance,
            Pick("cluster", row),
            reason,
            fixed_position(pose, center),
        )


def fixed_position(pose: F64, center: F32) -> Position:
    """Return a point in the fixed frame."""
    x, y, z = geometry.apply(pose, np.asarray(center, np.float32)[None])[0].tolist()
    return x, y, z
