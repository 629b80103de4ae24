"""Logs what ``bevviz why`` answered: the words, and the chain over the frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import rerun as rr

from bevviz import geometry
from bevviz.frame import F32, Camera, Frame
from bevviz.logging import entities
from bevviz.logging.camera import over_image
from bevviz.logging.pieces import boxes2d, document, edges, transform
from bevviz.logging.writer import Writer
from bevviz.why.answer import Answer
from bevviz.why.subject import projected
from bevviz.why.text import page
from bevviz.why.traces import Fate

COLORS = {
    Fate.GROUND: (170, 110, 60),
    Fate.NOISE: (255, 60, 60),
    Fate.SET_ASIDE: (255, 150, 40),
    Fate.CLUSTERED: (255, 230, 60),
    Fate.REPORTED: (80, 230, 110),
    Fate.IN_FRONT: (80, 140, 255),
}
_SUBJECT = (255, 60, 200)
_DEPTH = 20.0  # metres that a frustum is drawn to where the distance is unknown


def log_answers(recording: rr.RecordingStream, frame: Frame, answers: Sequence[Answer], shown: int) -> None:
    """The first answers over the frame, at the recording's current time; the words of all.

    Args:
        recording: where the frame itself was just logged to.
        frame: what was explained.
        answers: worst first.
        shown: how many of them are drawn.
    """
    recording.log(entities.WHY, document(page(answers, shown)))
    pose = transform(frame.pose)
    drawn = answers[:shown]
    fate = np.zeros(len(frame.points), np.uint8)
    for answer in reversed(drawn):
        fate = np.where(answer.fate > 0, answer.fate, fate).astype(np.uint8)
    known = fate > 0
    if known.any():
        colors = np.zeros((len(Fate), 3), np.uint8)
        colors[list(COLORS)] = list(COLORS.values())
        points = rr.Points3D(frame.points[known], colors=colors[fate[known]], radii=rr.Radius.ui_points(4.0))
        recording.log(entities.why("points"), pose, points)
    strips = [
        (edges(geometry.corners(a.subject.box)[0]), a.subject.name)
        for a in drawn
        if a.subject.box is not None
    ]
    strips += [strip for camera in frame.cameras for strip in _frustums(camera, drawn)]
    if strips:
        lines, names = zip(*strips, strict=True)
        place = rr.LineStrips3D(
            lines, colors=[_SUBJECT], radii=rr.Radius.ui_points(2.0), labels=names, show_labels=True
        )
        recording.log(entities.why("place"), pose, place)
    for camera in frame.cameras:
        _log_image(recording, camera, drawn)


def mark_answers(to: Writer, frame: Frame, answers: Sequence[Answer]) -> None:
    """The answers over the frame, and nothing of those before; gone again at the next frame.

    Args:
        to: a writer of its own, whose clock is set.
        frame: what was explained.
        answers: all are drawn.
    """
    to.set_time(frame.index, frame.stamp, frame.received)
    to.recording.log(entities.WHY, rr.Clear(recursive=True))
    log_answers(to.recording, frame, answers, len(answers))
    to.set_time(frame.index + 1, frame.stamp + 1, frame.received and frame.received + 1)
    to.recording.log(entities.WHY, rr.Clear(recursive=True))


def _frustums(camera: Camera, answers: Sequence[Answer]) -> Iterator[tuple[F32, str]]:
    """In Frame.points_frame."""
    if camera.intrinsics is None or camera.camera_from_points is None:
        return
    points_from_camera = geometry.inverse(camera.camera_from_points)
    for answer in answers:
        s = answer.subject
        if s.xyxy is not None and s.camera == camera.name:
            far = _DEPTH if np.isnan(answer.distance) else answer.distance
            corners = geometry.frustum(s.xyxy[None], camera.intrinsics, 0.5, far)[0]
            yield edges(geometry.apply(points_from_camera, corners)), s.name


def _log_image(recording: rr.RecordingStream, camera: Camera, answers: Sequence[Answer]) -> None:
    boxes, names = [], []
    for s in (answer.subject for answer in answers):
        own = s.xyxy if s.camera == camera.name else None
        box = projected(s.box, camera) if s.box is not None else own
        if box is not None:
            boxes.append(box)
            names.append(s.name)
    if boxes:
        recording.log(
            entities.why(f"{camera.name}/place"),
            over_image(camera.name),
            boxes2d(np.array(boxes), names, colors=[_SUBJECT], draw_order=40.0),
        )
