"""Findings: what went wrong in a frame. This is the one place that decides it.

The list of the workbench, the marks in a recording, the tables and the worst frames of a batch, the report
and the agent's tools show these findings.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from bevviz.config import Config
from bevviz.evaluate import RANGE
from bevviz.model import geometry
from bevviz.model.decisions import unmatched_detections
from bevviz.model.frame import F32, Bool, Boxes3D, Frame
from bevviz.model.results import Anomaly, Decision, FrameResult, Opinion
from bevviz.why import Answer, FrameExplainer, Selection
from bevviz.why.collect import center_of, ground_distance
from bevviz.why.false_objects import false_reasons
from bevviz.why.frame_index import FrameIndex, detection_subject
from bevviz.why.resolve import object_subject
from bevviz.why.verdict import Verdict

# Size of a cluster that may be a person, a bicycle or a car: longer side, shorter side and height in metres,
# and least number of points. Other clusters without a detection are nothing that a detector should know.
LENGTH, WIDTH, HEIGHT, FEW = (0.3, 6.0), 2.5, (1.0, 2.5), 30
WAY = 2.0  # metres to each side of the robot that it needs to drive straight on

KINDS: Mapping[str, float] = {  # kind -> severity of a finding
    "missed": 1.0,
    "false": 1.0,
    "lost": 1.0,
    "contradicted": 1.0,
    "doubtful": 0.5,
    "anomaly": 0.5,
    "unmatched": 1.0,  # times the score of the detection, and the factor below
    "unnamed": 0.05,
}
FACTORS = {Decision.NO_CLUSTER: 2.0, Decision.TOO_FEW_POINTS: 1.5, Decision.TOO_FAR: 0.5}  # others: 1

Position = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding.

    Attributes:
        frame: number of the scan.
        stamp: stamp of the scan, in nanoseconds.
        what: kind, see ``KINDS``, or a difference.
        name: name of the class, or "cluster", or the kind of an anomaly.
        distance: distance that the answer gives. NaN: unknown.
        selection: selection that asks about it. None: an anomaly.
        reason: reason that the answer gives.
        position: position in the fixed frame, if known.
        in_way: whether it is ahead of the robot, no more than ``WAY`` to the side.
        box: (4,) box in the image, for a detection without position.
        severity: severity, higher is worse.
        text: sentence of the answer.
        points: number of raw points on it.
        shape: box in the frame of the points, as one row. None: it has no position.
        number: identity over frames of an object of the ground truth or an anomaly; empty: unknown.
    """

    frame: int
    stamp: int
    what: str
    name: str
    distance: float
    selection: Selection | None
    reason: str = ""
    position: Position | None = None
    in_way: bool = False
    box: F32 | None = None
    severity: float = 0.0
    text: str = ""
    points: int = 0
    shape: Boxes3D | None = None
    number: str = ""

    @property
    def subject(self) -> str:
        """Subject of an anomaly; empty: it is none."""
        return self.number.rpartition(", ")[0] if self.what == "anomaly" else ""


def find_findings(explainer: FrameExplainer, *, restore: bool = True) -> list[Finding]:
    """Return the findings of a frame with their reasons, see ``findings_of``.

    Args:
        explainer: explainer of the frame.
        restore: whether missed objects of the ground truth get a reason. It takes several runs of the stages.
    """
    return [_explained(finding, explainer, restore=restore) for finding in findings_of(explainer.traces)]


def findings_of(traces: FrameIndex) -> list[Finding]:
    """Return the findings of a frame, the nearest first, without reasons. Reasons take several times as long.

    With ground truth these are missed and false objects, as ``evaluate`` counts them. Without it they are:

    - contradicted: objects of another perception that a camera contradicts,
    - lost: objects that it has lost and our fusion has,
    - doubtful: objects of our fusion that do not fit their detections,
    - unmatched: kept detections without an object,
    - unnamed: clusters of a road user's size in view without a detection.

    Those that had to be found are within 40 m and hold 10 points or more (``FrameIndex.must``). Anomalies are
    findings with and without ground truth.
    """
    result, truth = traces.result, traces.labels_in_evaluate
    findings = sorted(
        _unexplained(traces) if truth is None else _judged(traces),
        key=lambda finding: (finding.what == "false", finding.distance),
    )
    return [*findings, *(_of_anomaly(result.frame, anomaly) for anomaly in result.anomalies)]


def finding_of(frame: Frame, what: str, answer: Answer) -> Finding:
    """Return an answer about an object, a detection or a cluster as a finding."""
    subject, selection = answer.subject, answer.selection
    assert selection is not None
    name = subject.label or subject.kind
    finding = Finding(
        frame.index,
        frame.stamp,
        what,
        name.lower() if subject.kind == "truth" else name,
        answer.distance,
        selection,
        box=subject.xyxy,
        severity=KINDS.get(what, 0.0),
    )
    return _with_answer(frame, finding, answer)


def _explained(finding: Finding, explainer: FrameExplainer, *, restore: bool) -> Finding:
    """Add the answer about its subject to a finding."""
    if finding.selection is None:
        return finding
    frame = explainer.traces.result.frame
    if finding.what == "missed" and not restore:
        assert finding.shape is not None
        x, y, z = finding.shape.center[0].tolist()
        return _at(frame, finding, (x, y, z))
    if finding.selection.object is not None:
        subject = object_subject(explainer.traces, finding.selection.object)
        if (verdict := explainer.false_verdict(subject)) is not None:
            center, points = center_of(subject, explainer.traces.result, -1), explainer.traces.place(subject)
            distance = ground_distance(center, frame.points[points])
            return _with_verdict(frame, finding, verdict, distance, len(points), center)
    return _with_answer(frame, finding, explainer.about(finding.selection))


def _with_answer(frame: Frame, finding: Finding, answer: Answer) -> Finding:
    return _with_verdict(frame, finding, answer.verdict, answer.distance, answer.points, answer.center)


def _with_verdict(
    frame: Frame, finding: Finding, verdict: Verdict, distance: float, points: int, center: Position | None
) -> Finding:
    explained = replace(
        finding, distance=distance, reason=verdict.kind.value, text=verdict.text, points=points
    )
    return explained if center is None else _at(frame, explained, center)


def _at(frame: Frame, finding: Finding, center: Position) -> Finding:
    """Return a finding with its position in the fixed frame.

    Args:
        frame: frame of the finding.
        finding: the finding.
        center: its centre in the frame of the points.
    """
    x, y, z = geometry.apply(frame.pose, np.asarray(center, np.float32)[None])[0].tolist()
    return replace(finding, position=(x, y, z), in_way=center[0] > 0 and abs(center[1]) <= WAY)


def _judged(traces: FrameIndex) -> Iterator[Finding]:
    """Yield the missed objects and the false ones, by ground truth."""
    result, truth, matches = traces.result, traces.labels_in_evaluate, traces.matches
    assert truth is not None
    if has_detector(result.config) or any(camera.detections is not None for camera in result.cameras):
        for row in np.flatnonzero(truth.must if matches is None else matches.missed).tolist():
            number = truth.ids[row] if truth.ids else ""
            yield _of_box(
                result, "missed", Selection(truth=row), truth.labels[row].lower(), truth.boxes, number
            )
    false = [] if matches is None else np.flatnonzero(matches.false).tolist()
    yield from _of_objects(result, "false", false)


def has_detector(config: Config) -> bool:
    """Return whether objects can have a class. Without one, every object would be missed."""
    return bool(config.detector.model) or config.objects.method != "frustum"


def _unexplained(traces: FrameIndex) -> Iterator[Finding]:
    """Yield what no ground truth judges, and what nothing explains."""
    result = traces.result
    if (opinions := result.opinions) is not None:
        contradicted = np.flatnonzero(opinions.opinion == Opinion.CONTRADICTED).tolist()
        yield from _of_objects(result, "contradicted", contradicted)
        fused = opinions.fused
        for row in np.flatnonzero(opinions.missed).tolist():
            lost = _of_detection(traces, "lost", fused.camera[row], int(fused.detection[row]))
            if lost is not None:
                yield replace(lost, shape=fused.boxes.chosen([row]))
    yield from _of_objects(result, "doubtful", false_reasons(traces))
    for camera in result.cameras:
        for row in unmatched_detections(camera).tolist():
            if (unmatched := _of_detection(traces, "unmatched", camera.camera.name, row)) is not None:
                yield unmatched
    if (clusters := result.clusters) is not None:
        boxes = clusters.boxes(result.config.clustering)
        for row in np.flatnonzero(_are_unnamed(result)).tolist():
            yield _of_box(result, "unnamed", Selection(cluster=row), "cluster", boxes)


def _are_unnamed(result: FrameResult) -> Bool:
    """Return (C,) which clusters of a road user's size a camera sees and no detection names."""
    clusters = result.clusters
    assert clusters is not None
    named = np.zeros(len(clusters), bool)
    seen = named.copy()
    for camera in result.cameras:
        if camera.fusion is not None:
            named |= camera.fusion.cluster_decision == Decision.MATCHED
            seen |= camera.fusion.cluster_decision == Decision.NO_DETECTION
    boxes = clusters.obb
    length, width, height = boxes.size[:, :2].max(axis=1), boxes.size[:, :2].min(axis=1), boxes.size[:, 2]
    is_right_size = (length >= LENGTH[0]) & (length <= LENGTH[1]) & (width <= WIDTH)
    is_right_size &= (height >= HEIGHT[0]) & (height <= HEIGHT[1]) & (clusters.count >= FEW)
    near = boxes.distance <= RANGE
    return np.asarray(clusters.kept & seen & ~named & is_right_size & near, bool)


def _of_objects(result: FrameResult, what: str, rows: Iterable[int]) -> Iterator[Finding]:
    """Yield reported objects as findings."""
    objects = result.objects
    for row in rows:
        assert objects is not None
        yield _of_box(result, what, Selection(object=row), objects.names[row], objects.boxes)


def _of_box(
    result: FrameResult, what: str, selection: Selection, name: str, boxes: Boxes3D, number: str = ""
) -> Finding:
    """Return a finding about one of several boxes, whose row is that of the selection."""
    frame, box = result.frame, boxes.chosen([selection.row])
    distance, severity = float(box.distance[0]), KINDS[what]
    return Finding(
        frame.index, frame.stamp, what, name, distance, selection, severity=severity, shape=box, number=number
    )


def _of_detection(traces: FrameIndex, what: str, camera_name: str, row: int) -> Finding | None:
    """Return a detection as a finding; None: it did not have to be found."""
    camera, frame = traces.result.camera(camera_name), traces.result.frame
    if camera is None or camera.detections is None:
        return None
    subject = detection_subject(traces.result, camera, row)
    if not traces.must(subject):
        return None
    severity = KINDS[what]
    if what == "unmatched" and camera.fusion is not None:
        factor = FACTORS.get(Decision(int(camera.fusion.detection_decision[row])), 1.0)
        severity *= factor * float(camera.detections.score[row])
    selection, name = Selection(detection=row, camera=camera_name), camera.detections.names[row]
    cluster = -1 if camera.fusion is None else int(camera.fusion.detection_cluster[row])
    center = center_of(subject, traces.result, cluster)
    distance = ground_distance(center, frame.points[traces.place(subject)])
    return Finding(
        frame.index, frame.stamp, what, name, distance, selection, box=subject.xyxy, severity=severity
    )


def _of_anomaly(frame: Frame, anomaly: Anomaly) -> Finding:
    """Return an anomaly as a finding. A lasting one has the same number in all of its frames."""
    return Finding(
        frame.index,
        frame.stamp,
        "anomaly",
        anomaly.kind.replace("_", " "),
        float("nan"),
        None,
        reason=anomaly.kind.replace("_", " "),
        severity=KINDS["anomaly"],
        text=anomaly.text,
        number=f"{anomaly.subject}, {anomaly.since}",
    )
