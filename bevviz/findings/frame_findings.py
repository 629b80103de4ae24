"""Findings: missed, false and unexplained objects of a frame. A finding is an answer of ``why`` in brief."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bevviz.evaluate import RANGE
from bevviz.model import geometry
from bevviz.model.frame import F32, Frame
from bevviz.model.results import Decision, Opinion
from bevviz.why import Answer, FrameExplainer, Selection

FEW = 30  # points. A smaller cluster without a detection is probably no object of a known class.
WAY = 2.0  # metres to each side of the robot that it needs to drive straight on

Position = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding.

    Attributes:
        frame: number of the scan.
        stamp: stamp of the scan, in nanoseconds.
        what: kind: missed, false, doubtful, contradicted, lost, unmatched, unnamed, or a difference.
        name: name of the class, or "cluster".
        distance: distance that the answer gives. NaN: unknown.
        selection: selection that asks about it.
        reason: reason that the answer gives.
        position: position in the fixed frame, if known.
        in_way: whether it is ahead of the robot, no more than ``WAY`` to the side.
        box: (4,) box in the image, for a detection without position.
    """

    frame: int
    stamp: int
    what: str
    name: str
    distance: float
    selection: Selection
    reason: str = ""
    position: Position | None = None
    in_way: bool = False
    box: F32 | None = None


def find_findings(explainer: FrameExplainer) -> list[Finding]:
    """Return the findings of a frame, those within 40 m and all false objects, nearest first.

    With ground truth these are missed and false objects. Without it they are:

    - objects of another perception that a camera contradicts,
    - objects that it has lost and our fusion has,
    - doubtful objects,
    - kept detections without a cluster,
    - clusters in view without a detection.
    """
    traces = explainer.traces
    named = _judged(explainer) if traces.labels_in_evaluate is not None else _unexplained(explainer)
    findings = [finding_of(traces.result.frame, what, answer) for what, answer in named]
    near_findings = [
        finding for finding in findings if finding.what == "false" or not finding.distance > RANGE
    ]
    return sorted(
        near_findings,
        key=lambda finding: (finding.what == "false", np.nan_to_num(finding.distance, nan=RANGE)),
    )


def finding_of(frame: Frame, what: str, answer: Answer) -> Finding:
    """Return an answer about an object, a detection or a cluster as a finding."""
    subject, selection, position, in_way = answer.subject, answer.selection, None, False
    assert selection is not None
    if answer.center is not None:
        in_way = answer.center[0] > 0 and abs(answer.center[1]) <= WAY
        x, y, z = geometry.apply(frame.pose, np.asarray(answer.center, np.float32)[None])[0].tolist()
        position = x, y, z
    name, reason = subject.label or subject.kind, answer.verdict.kind.value
    if subject.kind == "truth":
        name = name.lower()
    return Finding(
        frame.index,
        frame.stamp,
        what,
        name,
        answer.distance,
        selection,
        reason,
        position,
        in_way,
        subject.xyxy,
    )


def _judged(explainer: FrameExplainer) -> Iterator[tuple[str, Answer]]:
    """Yield the missed objects and the false ones, by ground truth."""
    truth, matches = explainer.traces.labels_in_evaluate, explainer.traces.matches
    assert truth is not None
    for row in np.flatnonzero(truth.must if matches is None else matches.missed).tolist():
        yield "missed", explainer.about(Selection(truth=row))
    yield from (("false", answer) for answer in explainer.false_objects())


def _unexplained(explainer: FrameExplainer) -> Iterator[tuple[str, Answer]]:
    """Yield doubtful objects, detections without a cluster and clusters without a detection."""
    result = explainer.traces.result
    clusters, opinions = result.clusters, result.opinions
    if opinions is not None:
        for row in np.flatnonzero(opinions.opinion == Opinion.CONTRADICTED).tolist():
            yield "contradicted", explainer.about(Selection(object=row))
        for row in np.flatnonzero(opinions.missed).tolist():
            detection, camera_name = int(opinions.fused.detection[row]), opinions.fused.camera[row]
            yield "lost", explainer.about(Selection(detection=detection, camera=camera_name))
    yield from (("doubtful", answer) for answer in explainer.false_objects())
    named = np.zeros(0 if clusters is None else len(clusters), bool)
    in_view = named.copy()
    for camera in result.cameras:
        detections, fusion = camera.detections, camera.fusion
        if detections is None or fusion is None:
            continue
        named |= fusion.cluster_decision == Decision.MATCHED
        in_view |= fusion.cluster_decision == Decision.NO_DETECTION
        for row in np.flatnonzero(detections.kept & (fusion.detection_decision != Decision.MATCHED)).tolist():
            yield "unmatched", explainer.about(Selection(detection=row, camera=camera.camera.name))
    if clusters is None:
        return
    near = clusters.boxes(result.config.clustering).distance <= RANGE
    for row in np.flatnonzero(in_view & ~named & clusters.kept & (clusters.count >= FEW) & near).tolist():
        yield "unnamed", explainer.about(Selection(cluster=row))
