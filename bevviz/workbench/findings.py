"""Findings: missed, false and unexplained objects of a frame, and the list of them over the drive.

A finding is an answer of ``why`` in brief. One that lasts several frames is one group of the list.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bevviz.evaluate import RANGE
from bevviz.model import geometry
from bevviz.model.frame import F32, Frame
from bevviz.model.results import Anomaly, Decision, Opinion
from bevviz.why import Answer, FrameExplainer, Selection

FEW = 30  # points. A smaller cluster without a detection is probably no object of a known class.

REACH = 2.5  # metres that an object may have moved since the last frame with this finding
WAY = 2.0  # metres to each side of the robot that it needs to drive straight on
GAP = 5  # frames without the finding after which a new group begins
CELL = 64  # frames that single frames of an overview are grouped over
SAME_BOX = 0.3  # IoU of the image boxes of one detection in two frames

DIFFERENCES = {  # kind -> remark
    "fixed": "The tried values report it.",
    "broken": "The tried values lose it, without them it is right.",
    "new false": "The tried values make it, without them it is not there.",
    "false gone": "The tried values remove it.",
    "new": "The tried values make it.",
    "gone": "The tried values lose it.",
}
_SENSOR = "Nothing was tried: no parameter of a stage mends"
ANOMALIES = {  # kind -> remark
    "sensor": f"{_SENSOR} a sensor.",
    "sync": f"{_SENSOR} the clocks of two sensors.",
    "tf": f"{_SENSOR} a transform.",
    "stage": "Nothing was tried: a stage fails or is slow.",
    "one_sensor": "Nothing was tried: it lasts several frames, click an object of it to ask.",
    "jump": "Nothing was tried: it lasts several frames, click the object to ask.",
    "flicker": "Nothing was tried: it lasts several frames, click the object to ask.",
}

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


# --- list over the drive -----------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FindingFrame:
    """One frame of a finding.

    Attributes:
        frame: number of the scan.
        stamp: stamp of the scan, in nanoseconds.
        distance: distance in metres. NaN: unknown.
        pick: text of the selection that asks about it. Empty: there is nothing to ask.
        tried: whether the tried side shows it, rather than the drive as it was opened.
        text: reason in this frame.
        remark: one sentence where no hint can be searched.
        in_way: whether it is in the way of the robot.
    """

    frame: int
    stamp: int
    distance: float
    pick: str
    tried: bool = False
    text: str = ""
    remark: str = ""
    in_way: bool = False

    def as_list(self) -> list[Any]:
        """Return the values for the page. The stamp is text: JavaScript numbers cannot hold it."""
        distance = None if math.isnan(self.distance) else round(self.distance, 1)
        head = [self.frame, str(self.stamp), distance, self.pick, self.tried]
        return [*head, self.text, self.remark, self.in_way]


@dataclass(slots=True)
class FindingGroup:
    """One finding in all of its frames."""

    number: int
    what: str
    name: str
    frames: list[FindingFrame] = field(default_factory=list)
    position: Position | None = None  # position in the last frame
    box: F32 | None = None


class FindingList:
    """All groups of findings. One thread at a time may add to it, any thread may read it."""

    def __init__(self) -> None:
        self._groups: dict[int, FindingGroup] = {}
        self._recent: dict[tuple[str, str], list[FindingGroup]] = {}
        self._overview: dict[int, list[FindingGroup]] = {}  # groups of single frames, by cell of the drive
        self._number = 0
        self._lock = threading.Lock()

    def add(self, findings: Iterable[Finding], *, tried: bool = False) -> None:
        """Add the findings of the next frame.

        A finding near a recent one of the same kind and name joins its group.
        """
        with self._lock:
            taken_groups: set[int] = set()
            for finding in findings:
                group = self._same(finding, taken_groups) or self._new_recent(finding.what, finding.name)
                self._extend(group, finding, taken_groups, tried)

    def add_overview(self, frame: int, findings: Iterable[Finding]) -> None:
        """Add the findings of a single frame. They stay until ``end_overview`` reaches the frame.

        A finding near one of the same kind and name joins its group, within ``CELL`` frames.
        """
        with self._lock:
            groups, taken_groups = self._overview.setdefault(frame // CELL, []), set[int]()
            for finding in findings:
                kind = finding.what, finding.name
                near = _nearest(
                    (one for one in groups if (one.what, one.name) == kind), finding, taken_groups
                )
                if near is None:
                    groups.append(near := self._new(*kind))
                self._extend(near, finding, taken_groups)

    def end_overview(self, frame: int) -> None:
        """Remove the findings of single frames up to the cell of a frame. The run in order has reached it."""
        with self._lock:
            for cell in [cell for cell in self._overview if cell <= frame // CELL]:
                for group in self._overview.pop(cell):
                    del self._groups[group.number]

    def _extend(
        self, group: FindingGroup, finding: Finding, taken_groups: set[int], tried: bool = False
    ) -> None:
        """Add one finding to a group."""
        taken_groups.add(group.number)
        group.position, group.box = finding.position, finding.box
        group.frames.append(
            FindingFrame(
                finding.frame,
                finding.stamp,
                finding.distance,
                str(finding.selection),
                tried,
                finding.reason,
                DIFFERENCES.get(finding.what, ""),
                finding.in_way,
            )
        )

    def _same(self, finding: Finding, taken_groups: set[int]) -> FindingGroup | None:
        groups = self._recent.get((finding.what, finding.name), [])
        groups[:] = [group for group in groups if 0 <= finding.frame - group.frames[-1].frame <= GAP]
        return _nearest(groups, finding, taken_groups)

    def _new_recent(self, kind: str, name: str) -> FindingGroup:
        group = self._new(kind, name)
        self._recent.setdefault((kind, name), []).append(group)
        return group

    def _new(self, kind: str, name: str) -> FindingGroup:
        self._number += 1
        group = FindingGroup(self._number, kind, name)
        self._groups[group.number] = group
        return group

    def add_anomalies(self, frame: int, stamp: int, anomalies: Sequence[Anomaly]) -> None:
        """Add the anomalies that begin in a frame."""
        with self._lock:
            for anomaly in anomalies:
                kind = anomaly.kind.replace("_", " ")
                finding_frame = FindingFrame(
                    frame, stamp, math.nan, "", text=anomaly.text, remark=ANOMALIES[anomaly.kind]
                )
                self._new("anomaly", kind).frames.append(finding_frame)

    def content(self) -> list[tuple[str, str, list[FindingFrame]]]:
        """Return kind, name and frames of each group."""
        with self._lock:
            return [(group.what, group.name, list(group.frames)) for group in self._groups.values()]

    def restore(self, groups: Iterable[tuple[str, str, list[FindingFrame]]]) -> None:
        """Add whole groups of an earlier run."""
        with self._lock:
            for kind, name, frames in groups:
                self._new(kind, name).frames += frames

    def replace(self, kinds: Sequence[str]) -> None:
        """Remove all findings of these kinds, before new ones are added."""
        with self._lock:
            for number in [number for number, group in self._groups.items() if group.what in kinds]:
                del self._groups[number]
            for key in [key for key in self._recent if key[0] in kinds]:
                del self._recent[key]

    def reasons(self) -> dict[tuple[int, str], str]:
        """Return the reasons of the findings of the drive as opened, by frame and text of the selection."""
        with self._lock:
            frames = [one for group in self._groups.values() for one in group.frames]
        return {(one.frame, one.pick): one.text for one in frames if not one.tried}

    def news(self, sent_counts: dict[int, int]) -> Iterator[dict[str, Any]]:
        """Yield the news for a page. ``sent_counts`` counts the frames that it has of each group."""
        with self._lock:
            gone = [number for number in sent_counts if number not in self._groups]
            changed_groups = [
                group
                for group in self._groups.values()
                if len(group.frames) > sent_counts.get(group.number, 0)
            ]
            new_items = [
                {
                    "number": group.number,
                    "what": group.what,
                    "name": group.name,
                    "sights": [frame.as_list() for frame in group.frames[sent_counts.get(group.number, 0) :]],
                }
                for group in changed_groups
            ]
            sent_counts.update((group.number, len(group.frames)) for group in changed_groups)
        for number in gone:
            del sent_counts[number]
        if gone or new_items:
            yield {"type": "entries", "entries": new_items, "gone": gone}


def _nearest(groups: Iterable[FindingGroup], finding: Finding, taken_groups: set[int]) -> FindingGroup | None:
    """Return the nearest group that a finding may join. None: there is none."""
    candidates = [
        (_relative_distance(group, finding), group.number, group)
        for group in groups
        if group.number not in taken_groups
    ]
    best, _, group = min(candidates, default=(math.inf, -1, None))
    return group if best <= 1 else None


def _relative_distance(group: FindingGroup, finding: Finding) -> float:
    """Return the distance from the last position of a group, divided by the largest allowed distance."""
    if group.position is not None and finding.position is not None:
        return float(np.linalg.norm(np.subtract(group.position, finding.position))) / REACH
    if group.box is not None and finding.box is not None:
        return 1.0 if geometry.iou(group.box[None], finding.box[None])[0, 0] >= SAME_BOX else math.inf
    return math.inf
