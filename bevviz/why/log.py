"""Log the answers of ``bevviz why``: the sentences, and the subjects and points over the frame."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import rerun as rr

from bevviz.config import BevConfig
from bevviz.model import geometry
from bevviz.model.frame import F32, U8, Boxes3D, Camera, Frame
from bevviz.model.results import FrameResult
from bevviz.recording import entities
from bevviz.recording.focus import Focus, dim_rest, eye_distance, log_focus
from bevviz.recording.labels import under
from bevviz.recording.layers import Layer, Style, draw, name_layers
from bevviz.recording.primitives import document, transform
from bevviz.recording.projection import bev_outlines, bev_pixels, edges
from bevviz.recording.writer import Writer
from bevviz.support.colors import FATE_COLORS, StateColor
from bevviz.why.answer import Answer
from bevviz.why.answer_text import markdown_page
from bevviz.why.frame_index import Fate

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
_NAME = 0.035  # of the distance from the eye to a subject, from its top to its name
_MARGIN = np.float32(0.06)  # metres that the outline of a subject is longer than its box, whose lines hide it
_LENGTH = 2.0  # metres, of a subject without a box
_DEPTH = 20.0  # metres, length of a frustum where the distance is unknown


def clear_answers(to: Writer) -> None:
    """Clear all answers from the writer's current time on."""
    for path in (entities.WHY, entities.OVERLAY.path("why")):
        to.write(path, rr.Clear(recursive=True))


def log_answers(
    to: Writer,
    frame: Frame,
    answers: Sequence[Answer],
    shown: int,
    above: BevConfig | None = None,
    counted: bool = True,
) -> None:
    """Log the sentences of all answers, and draw the first ones at the writer's current time.

    Args:
        to: writer to which the frame was just logged.
        frame: the explained frame.
        answers: the answers, worst first.
        shown: number of answers to draw.
        above: configuration of the bird's-eye view, to draw there as well.
        counted: write the meaning of the colours beside the first one.
    """
    to.write(entities.WHY, document(markdown_page(answers, shown)))
    drawn = answers[:shown]
    fate = np.zeros(len(frame.points), np.uint8)
    for answer in reversed(drawn):
        fate = np.where(answer.fate > 0, answer.fate, fate).astype(np.uint8)
    known = fate > 0
    colors = np.zeros((len(Fate), 3), np.uint8)
    colors[list(COLORS)] = list(COLORS.values())
    strips, widths = list[F32](), list[float]()
    for answer in drawn:
        box = answer.subject.box
        lines = [] if box is None else [edges(geometry.corners(replace(box, size=box.size + _MARGIN))[0])]
        lines += [strip for camera in frame.cameras for strip in _frustums(camera, answer)]
        strips += lines
        widths += [2.5 if answer is drawn[0] else 0.5] * len(lines)
    points, place = entities.WHY_PART.path("points"), entities.WHY_PART.path("place")
    layers = [
        *_legend(frame, drawn, counted),
        Layer(points, frame.points[known], Style(width=4.0), colors=colors[fate[known]]),
        Layer(place, strips, Style(_SUBJECT), widths=widths),
    ]
    for layer in layers:
        _log_frame_of_points(to, layer, frame)
    images = [layer for camera in frame.cameras for layer in _image_layers(camera, drawn)]
    draw(to, *layers, *images, *_layers_above(frame, drawn, above, fate), put=to.write)


def _log_frame_of_points(to: Writer, layer: Layer, frame: Frame) -> None:
    """Log the coordinate frame of a layer in space: that of the sensor, or a pose where there is none.

    The frame of the sensor is static, because Rerun drops a frame that is logged at the time of a recursive
    clear.
    """
    if len(layer.items) and not frame.lidar:
        to.write(layer.path, transform(frame.pose))
    elif len(layer.items):
        to.static(layer.path, rr.CoordinateFrame(entities.space(entities.SENSOR.path(frame.lidar))))


def focus_point(frame: Frame, answer: Answer) -> F32 | None:
    """Return the (3,) position of an answer in Frame.points_frame; None: unknown."""
    if answer.subject.box is not None:
        return np.asarray(answer.subject.box.center[0], np.float32)
    if len(answer.fate) != len(frame.points):
        return None
    points = frame.points[(answer.fate > 0) & (answer.fate != Fate.IN_FRONT)]
    return np.median(points, axis=0).astype(np.float32) if len(points) else None


def _legend(frame: Frame, drawn: Sequence[Answer], counted: bool) -> Iterator[Layer]:
    """Yield the name of the worst subject above it. ``counted``: with the meaning of its colours."""
    place = focus_point(frame, drawn[0]) if drawn else None
    if place is None:
        return
    subject, counts = drawn[0].subject, np.bincount(drawn[0].fate, minlength=len(Fate))
    fates = [fate for fate in COLORS if counts[fate]] if counted else []
    lines = [f"{counts[fate]} {NAMES[fate]}" for fate in fates] + [subject.name]
    colors = [COLORS[fate] for fate in fates] + [_SUBJECT]
    top = place[2] + (0.5 if subject.box is None else subject.box.size[0, 2] / 2)
    line = _LINE if counted else _NAME * eye_distance(_length(drawn[0]))
    places = np.tile(place, (len(lines), 1))
    places[:, 2] = top + line * (1 + np.arange(len(lines)))
    path, style = entities.WHY_PART.path("legend"), Style(width=0.0, labels=True)
    yield Layer(path, places, style, lines, colors=colors)


def _layers_above(
    frame: Frame, answers: Sequence[Answer], config: BevConfig | None, fate: U8
) -> Iterator[Layer]:
    """Yield the outlines of the boxes in the bird's-eye view, or the points if there is no box."""
    if config is None:
        return
    path, boxes = entities.OVERLAY.path("why"), [a.subject.box for a in answers if a.subject.box is not None]
    if boxes:
        _, outlines = bev_outlines(config, Boxes3D.joined(boxes))
        yield Layer(path, outlines, Style(_SUBJECT, 2.5, order=40.0))
    else:
        dots = bev_pixels(config, np.eye(4), frame.points[fate > 0])
        reach = 2 * np.array([config.range_y, config.range_x]) / config.resolution
        inside = ((dots > 0) & (dots < reach)).all(axis=1)
        yield Layer(path, dots[inside], Style(_SUBJECT, 2.0, order=40.0))


def mark_answers(to: Writer, frame: Frame, answers: Sequence[Answer], above: BevConfig | None = None) -> None:
    """Log the answers over one frame. Earlier answers are cleared, and these end at the next frame.

    Args:
        to: a writer for the answers only.
        frame: the explained frame.
        answers: the answers; all are drawn.
        above: as for ``log_answers``.
    """
    to.refresh()  # A viewer may lack what was logged with earlier answers.
    to.set_time(frame.index, frame.stamp, frame.received)
    clear_answers(to)
    log_answers(to, frame, answers, len(answers), above, counted=False)
    to.set_time(frame.index + 1, frame.stamp + 1, frame.received and frame.received + 1)
    clear_answers(to)


def focus_answer(to: Writer, result: FrameResult, answer: Answer, number: int) -> Focus:
    """Bring the subject of an answer before the eye of every view, and dim the rest of its frame.

    Args:
        to: writer of the answers.
        result: result of the frame.
        answer: the answer.
        number: number of the answer in its page.

    Returns:
        The focus, for the positions of clicks.
    """
    frame = result.frame
    boxes, place = _image_boxes(frame, answer), focus_point(frame, answer)
    if place is None:
        strips = [strip for camera in frame.cameras for strip in _frustums(camera, answer)]
        place = np.concatenate(strips).mean(axis=0) if strips else None
    focus = Focus.on(frame, place, _length(answer), boxes)
    log_focus(to, frame, focus, number)
    dim_others(to, result, answer)
    return focus


def dim_others(to: Writer, result: FrameResult, answer: Answer) -> None:
    """Dim all of a frame but the subject of an answer.

    Args:
        to: writer of the answers.
        result: result of the frame.
        answer: the answer.
    """
    to.set_time(result.frame.index, result.frame.stamp, result.frame.received)
    dim_rest(to, result, _image_boxes(result.frame, answer))


def _length(answer: Answer) -> float:
    """Return the longest side of an answer's subject in metres."""
    return _LENGTH if answer.subject.box is None else float(answer.subject.box.size.max())


def _frustums(camera: Camera, answer: Answer) -> list[F32]:
    """Return the frustum of an answer's image box in a camera as line strips in Frame.points_frame."""
    subject = answer.subject
    if camera.intrinsics is None or camera.camera_from_points is None:
        return []
    if subject.xyxy is None or subject.camera != camera.name:
        return []
    far = _DEPTH if np.isnan(answer.distance) else answer.distance
    corners = geometry.frustum(subject.xyxy[None], camera.intrinsics, 0.5, far)[0]
    return [edges(geometry.apply(geometry.inverse(camera.camera_from_points), corners))]


def _image_layers(camera: Camera, answers: Sequence[Answer]) -> Iterator[Layer]:
    """Yield the boxes of the subjects over a camera's image, and the name of the first one."""
    boxes_by_row = {row: answer.subject.image_box(camera) for row, answer in enumerate(answers)}
    seen = {row: box for row, box in boxes_by_row.items() if box is not None}
    if not seen:
        return
    boxes, order = np.array(list(seen.values()), np.float32), 40.0
    path = entities.WHY_PART.path(f"{camera.name}/place")
    yield Layer(path, boxes, Style(_SUBJECT, order=order), frame=camera.name)
    if 0 in seen:  # The label of a box is as narrow as the box.
        name = [answers[0].subject.name]
        yield from name_layers(path, under(boxes[:1]), name, name, order, _SUBJECT, camera.name)


def cameras_of(frame: Frame, answer: Answer) -> list[str]:
    """Return the names of the cameras that show an answer's subject, the one with the largest box first."""
    pictured = {camera.name for camera in frame.cameras if camera.image is not None}
    boxes = _image_boxes(frame, answer)
    return sorted(
        boxes.keys() & pictured, key=lambda name: -float(np.prod(boxes[name][2:] - boxes[name][:2]))
    )


def _image_boxes(frame: Frame, answer: Answer) -> dict[str, F32]:
    """Return the (4,) box of an answer's subject in the image of each camera that sees it."""
    boxes = {camera.name: answer.subject.image_box(camera) for camera in frame.cameras}
    return {name: box for name, box in boxes.items() if box is not None}
