"""Log the answers of ``bevviz why``: the sentences, and the subjects and points over the frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import rerun as rr

from bevviz.config import BevConfig
from bevviz.model import geometry
from bevviz.model.frame import F32, U8, Camera, Frame
from bevviz.recording import entities
from bevviz.recording.images import bev_pixels, ground_outlines, image_frame
from bevviz.recording.primitives import boxes2d, document, edges, transform
from bevviz.recording.writer import Writer
from bevviz.support.colors import FATE_COLORS, StateColor
from bevviz.why.answer import Answer
from bevviz.why.answer_text import markdown_page
from bevviz.why.frame_index import Fate
from bevviz.why.subject import projected_box

COLORS = {
    Fate.GROUND: FATE_COLORS["ground"],
    Fate.NOISE: FATE_COLORS["noise"],
    Fate.SET_ASIDE: FATE_COLORS["set aside"],
    Fate.CLUSTERED: FATE_COLORS["clustered"],
    Fate.REPORTED: FATE_COLORS["reported"],
    Fate.IN_FRONT: FATE_COLORS["in front"],
}
NAMES = {
    Fate.GROUND: "taken for ground",
    Fate.NOISE: "noise",
    Fate.SET_ASIDE: "set aside",
    Fate.CLUSTERED: "in a cluster without a name",
    Fate.REPORTED: "in an object",
    Fate.IN_FRONT: "in front of it",
}
_SUBJECT = StateColor.SUBJECT.value
_LINE = 0.65  # metres between the lines of the legend
_DEPTH = 20.0  # metres, length of a frustum where the distance is unknown


def clear_answers(recording: rr.RecordingStream) -> None:
    """Clear all answers from the recording's current time on."""
    for path in (entities.WHY, entities.OVERLAY.path("why")):
        recording.log(path, rr.Clear(recursive=True))


def log_answers(
    recording: rr.RecordingStream,
    frame: Frame,
    answers: Sequence[Answer],
    shown: int,
    above: BevConfig | None = None,
) -> None:
    """Log the sentences of all answers, and draw the first ones at the recording's current time.

    Args:
        recording: recording that the frame was just logged to.
        frame: the explained frame.
        answers: the answers, worst first.
        shown: number of answers to draw.
        above: configuration of the bird's-eye view, to draw there as well.
    """
    recording.log(entities.WHY, document(markdown_page(answers, shown)))
    place_frame = _frame_of_points(frame)
    drawn = answers[:shown]
    if drawn:
        _log_legend(recording, frame, drawn[0])
    fate = np.zeros(len(frame.points), np.uint8)
    for answer in reversed(drawn):
        fate = np.where(answer.fate > 0, answer.fate, fate).astype(np.uint8)
    known = fate > 0
    if known.any():
        colors = np.zeros((len(Fate), 3), np.uint8)
        colors[list(COLORS)] = list(COLORS.values())
        points = rr.Points3D(frame.points[known], colors=colors[fate[known]], radii=rr.Radius.ui_points(4.0))
        _log(recording, "points", place_frame, points)
    strips, widths = list[F32](), list[float]()
    for answer in drawn:
        box = answer.subject.box
        lines = [] if box is None else [edges(geometry.corners(box)[0])]
        lines += [strip for camera in frame.cameras for strip in _frustums(camera, [answer])]
        strips += lines
        widths += [2.0 if answer is drawn[0] else 0.5] * len(lines)
    if strips:
        place = rr.LineStrips3D(strips, colors=[_SUBJECT], radii=rr.Radius.ui_points(widths))
        _log(recording, "place", place_frame, place)
    for camera in frame.cameras:
        _log_image(recording, camera, drawn)
    if above is not None:
        _log_above(recording, frame, drawn, above, fate)


def _frame_of_points(frame: Frame) -> rr.AsComponents:
    """Return the coordinate frame of the points: that of the sensor, or a pose where there is none."""
    if not frame.lidar:
        return transform(frame.pose)
    return rr.CoordinateFrame(entities.space(entities.SENSOR.path(frame.lidar)))


def _log(recording: rr.RecordingStream, name: str, place: rr.AsComponents, data: rr.AsComponents) -> None:
    """Log data in a coordinate frame. Rerun drops a frame that is logged at the time of a recursive clear."""
    recording.log(entities.WHY_PART.path(name), place, static=isinstance(place, rr.CoordinateFrame))
    recording.log(entities.WHY_PART.path(name), data)


def focus_point(frame: Frame, answer: Answer) -> F32 | None:
    """Return the (3,) position of an answer in Frame.points_frame; None: unknown."""
    if answer.subject.box is not None:
        return np.asarray(answer.subject.box.center[0], np.float32)
    points = frame.points[(answer.fate > 0) & (answer.fate != Fate.IN_FRONT)]
    return np.median(points, axis=0).astype(np.float32) if len(points) else None


def _log_legend(recording: rr.RecordingStream, frame: Frame, answer: Answer) -> None:
    """Log the name of the worst subject and the meaning of its colours above it."""
    place = focus_point(frame, answer)
    if place is None:
        return
    counts = np.bincount(answer.fate, minlength=len(Fate))
    fates = [fate for fate in COLORS if counts[fate]]
    lines = [f"{counts[fate]} {NAMES[fate]}" for fate in fates] + [answer.subject.name]
    colors = [COLORS[fate] for fate in fates] + [_SUBJECT]
    box = answer.subject.box
    top = place[2] + (0.5 if box is None else box.size[0, 2] / 2)
    places = np.tile(place, (len(lines), 1))
    places[:, 2] = top + _LINE * (1 + np.arange(len(lines)))
    legend = rr.Points3D(places, labels=lines, colors=colors, radii=rr.Radius.ui_points(0), show_labels=True)
    _log(recording, "legend", _frame_of_points(frame), legend)


def _log_above(
    recording: rr.RecordingStream, frame: Frame, answers: Sequence[Answer], config: BevConfig, fate: U8
) -> None:
    """Log the outlines of the boxes in the bird's-eye view, or the points if there is no box."""
    reach = np.array([config.range_x, config.range_y], np.float32)
    boxes = [answer.subject.box for answer in answers if answer.subject.box is not None]
    inside = [box for box in boxes if (np.abs(box.center[0, :2]) < reach).all()]
    points = frame.points[fate > 0]
    points = points[(np.abs(points[:, :2]) < reach).all(axis=1)]
    marks: rr.LineStrips2D | rr.Points2D
    if inside:
        outlines = np.concatenate([ground_outlines(geometry.corners(box)) for box in inside])
        strips, radii = bev_pixels(config, np.eye(4), outlines), rr.Radius.ui_points(2.5)
        marks = rr.LineStrips2D(strips, radii=radii, colors=[_SUBJECT], draw_order=40.0)
    elif len(points) and not boxes:
        dots, radii = bev_pixels(config, np.eye(4), points), rr.Radius.ui_points(2.0)
        marks = rr.Points2D(dots, radii=radii, colors=[_SUBJECT], draw_order=40.0)
    else:
        return
    recording.log(entities.OVERLAY.path("why"), marks)


def mark_answers(to: Writer, frame: Frame, answers: Sequence[Answer], above: BevConfig | None = None) -> None:
    """Log the answers over one frame. Earlier answers are cleared, and these end at the next frame.

    Args:
        to: a writer for the answers only.
        frame: the explained frame.
        answers: the answers; all are drawn.
        above: as for ``log_answers``.
    """
    to.set_time(frame.index, frame.stamp, frame.received)
    clear_answers(to.recording)
    log_answers(to.recording, frame, answers, len(answers), above)
    to.set_time(frame.index + 1, frame.stamp + 1, frame.received and frame.received + 1)
    clear_answers(to.recording)


def _frustums(camera: Camera, answers: Sequence[Answer]) -> Iterator[F32]:
    """Yield the frustums of the camera's subjects as line strips in Frame.points_frame."""
    if camera.intrinsics is None or camera.camera_from_points is None:
        return
    points_from_camera = geometry.inverse(camera.camera_from_points)
    for answer in answers:
        subject = answer.subject
        if subject.xyxy is not None and subject.camera == camera.name:
            far = _DEPTH if np.isnan(answer.distance) else answer.distance
            corners = geometry.frustum(subject.xyxy[None], camera.intrinsics, 0.5, far)[0]
            yield edges(geometry.apply(points_from_camera, corners))


def _log_image(recording: rr.RecordingStream, camera: Camera, answers: Sequence[Answer]) -> None:
    """Log the image boxes of the subjects over a camera's image."""
    boxes, names = [], []
    for number, subject in enumerate(answer.subject for answer in answers):
        image_box = subject.xyxy if subject.camera == camera.name else None
        box = projected_box(subject.box, camera) if subject.box is not None else image_box
        if box is not None:
            boxes.append(box)
            names.append("" if number else subject.name)
    if boxes:
        image_boxes = boxes2d(np.array(boxes), names, colors=[_SUBJECT], draw_order=40.0)
        _log(recording, f"{camera.name}/place", image_frame(camera.name), image_boxes)
