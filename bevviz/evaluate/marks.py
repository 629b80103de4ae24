"""Observer that marks wrong and unexplained objects in a recording of a run."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import rerun as rr

from bevviz.evaluate.ground_truth import truth_of
from bevviz.evaluate.matching import AcceptedNames, judge
from bevviz.model import geometry
from bevviz.model.frame import Boxes3D, LabelledBoxes3D
from bevviz.model.protocols import Observer
from bevviz.model.results import Decision, FrameResult
from bevviz.recording.images import unexplained_detections
from bevviz.recording.marks import Mark, MarkState, box_mark, log_marks
from bevviz.recording.primitives import scored, texts_by_row
from bevviz.recording.writer import Writer

NEAR, UNMATCHED_DEPTH = 0.5, 20.0  # metres to both ends of the frustum of a detection without an object
# A cluster of a person's size: longer side and height in metres, points, and distance in metres.
PERSON_WIDTH, PERSON_HEIGHT, PERSON_POINTS, PERSON_RANGE = (0.3, 1.2), (1.0, 2.1), 30, 40.0


class MarkRecorder(Observer[FrameResult]):
    """Observer that marks missed and false objects, or what nothing explains where there is no ground truth.

    Args:
        recording: target, which also has the frames.
    """

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._writer = Writer(recording)
        self._names = AcceptedNames()

    def observe(self, result: FrameResult) -> None:
        """Log the marks of a frame."""
        frame = result.frame
        self._writer.begin(frame.index, frame.stamp, frame.received)
        if frame.truth is None:
            marks = [*_unmatched_detections(result), *_unnamed_clusters(result)]
        else:
            marks = [*self._wrong_objects(result, frame.truth)]
        log_marks(self._writer, result, marks)
        self._writer.end()

    def _wrong_objects(self, result: FrameResult, labelled: LabelledBoxes3D) -> Iterator[Mark]:
        """Yield the missed and the false objects, by the rules of ``evaluate``."""
        objects = result.objects
        has_detector = any(camera.detections is not None for camera in result.cameras)
        if objects is None or not (has_detector or len(objects)):
            return  # Every object would be missed.
        truth = truth_of(result.frame, labelled)
        self._names.add(truth)
        matches = judge(objects, truth)
        for row in np.flatnonzero(matches.missed).tolist():
            yield _wrong("missed", truth.boxes, row, truth.labels[row].lower())
        for row in np.flatnonzero(matches.false).tolist():
            if self._names.of(objects.names[row].lower()) is not None:
                yield _wrong("false", objects.boxes, row, objects.names[row])


def _wrong(state: MarkState, boxes: Boxes3D, row: int, name: str) -> Mark:
    """Return the mark of a missed or false object."""
    label = f"{state}: {name}"
    return box_mark(state, boxes, row, label, f"{label}, {boxes.distance[row]:.1f} m away")


def _unmatched_detections(result: FrameResult) -> Iterator[Mark]:
    """Yield the frustums of detections that no object explains."""
    for camera in result.cameras:
        detections, intrinsics = camera.detections, camera.camera.intrinsics
        points_from_camera = camera.camera.camera_from_points
        if detections is None or intrinsics is None or points_from_camera is None:
            continue
        if not len(rows := unexplained_detections(camera)):
            continue
        texts = texts_by_row(result.explanations, "detection", camera.camera.name)
        corners = geometry.frustum(detections.xyxy[rows], intrinsics, NEAR, UNMATCHED_DEPTH)
        corners = geometry.apply(geometry.inverse(points_from_camera), corners.reshape(-1, 3))
        for row, frustum in zip(rows.tolist(), corners.reshape(-1, 8, 3), strict=True):
            [label] = scored([detections.names[row]], [detections.score[row]])
            yield Mark("unexplained", label, texts.get(row, label), frustum)


def _unnamed_clusters(result: FrameResult) -> Iterator[Mark]:
    """Yield the near clusters of a person's size that a camera sees and no detection names."""
    clusters = result.clusters
    if clusters is None:
        return
    seen, named = np.zeros(len(clusters), bool), np.zeros(len(clusters), bool)
    for camera in result.cameras:
        if camera.fusion is not None:
            seen |= camera.fusion.cluster_decision == Decision.NO_DETECTION
            named |= camera.fusion.cluster_decision == Decision.MATCHED
    boxes = clusters.obb
    length, height = boxes.size[:, :2].max(axis=1), boxes.size[:, 2]
    is_person = (length >= PERSON_WIDTH[0]) & (length <= PERSON_WIDTH[1])
    is_person &= (height >= PERSON_HEIGHT[0]) & (height <= PERSON_HEIGHT[1])
    near = (boxes.distance <= PERSON_RANGE) & (clusters.count >= PERSON_POINTS)
    for row in np.flatnonzero(clusters.kept & seen & ~named & is_person & near).tolist():
        sentence = f"cluster {row}, {boxes.distance[row]:.1f} m away: of a person's size, under no detection"
        yield box_mark("unexplained", boxes, row, "", sentence)
