"""Mark objects in every view: missed, false, and unexplained where there is no ground truth.

Each state has a line style besides its colour: missed objects are dashed, false ones are crossed out, and
unexplained ones are dotted.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import rerun as rr

from bevviz.config import BevConfig
from bevviz.model import geometry
from bevviz.model.frame import F32, Boxes3D, Camera
from bevviz.model.results import FrameResult
from bevviz.recording import entities
from bevviz.recording.images import bev_pixels
from bevviz.recording.labels import IN_IMAGE, LETTER_WIDTH, choose_named, choose_named_in_3d, log_name_style
from bevviz.recording.primitives import CORNER, image_outlines, transform
from bevviz.recording.writer import Writer
from bevviz.support.colors import Color, StateColor

Lines: TypeAlias = tuple[tuple[int, int], ...]  # pairs of corners
MarkState: TypeAlias = Literal["missed", "false", "unexplained"]

MARK_COLORS: Mapping[MarkState, Color] = {
    "missed": StateColor.BAD.value,
    "false": StateColor.DOUBTFUL.value,
    "unexplained": StateColor.DOUBTFUL.value,
}
_DASHES: Mapping[MarkState, int] = {"missed": 4, "false": 1, "unexplained": 8}  # dashes of each line
_GAP = 0.45  # share of a dash that is its gap
# Lines between the corners of a box: all edges, the cross on its top, the rim seen from above.
_BOX: Lines = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
_CROSS: Lines = ((4, 6), (5, 7))
_FLAT_CROSS: Lines = ((0, 2), (1, 3))
_SIDES: Lines = _BOX[:4]
_WEDGE: Lines = ((0, 4), (1, 5), (2, 6), (3, 7), (4, 5), (5, 6), (6, 7), (7, 4))  # of a frustum


@dataclass(frozen=True, slots=True)
class Mark:
    """Marked object.

    Attributes:
        state: missed, false or unexplained.
        name: text beside it; empty: no text.
        sentence: text of the tooltip.
        corners: (8, 3) corners of its box or of its frustum, around the robot.
        box: its box, as one row; None: a detection without a position, marked by its frustum.
    """

    state: MarkState
    name: str
    sentence: str
    corners: F32
    box: Boxes3D | None = None

    @property
    def center(self) -> F32:
        """(3,) position of the name: the top of a box, or the far end of a frustum."""
        points = self.corners[4:]
        return np.asarray(points.mean(axis=0), np.float32)


def box_mark(state: MarkState, boxes: Boxes3D, row: int, name: str, sentence: str) -> Mark:
    """Return the mark of one of the boxes around the robot."""
    box = boxes.chosen([row])
    return Mark(state, name, sentence, geometry.corners(box)[0], box)


def log_mark_style(to: Writer, cameras: Iterable[str]) -> None:
    """Log the static style of marks in all views."""
    names = rr.Points3D.from_fields(
        radii=rr.Radius.ui_points(0.0), colors=[StateColor.SUBJECT.value], show_labels=True
    )
    for state, color in MARK_COLORS.items():
        path = entities.MARKED.path(state)
        to.static(path, rr.LineStrips3D.from_fields(colors=[color], radii=rr.Radius.ui_points(2.0)))
        to.static(entities.NAMES.path(path), names)
        for flat in (
            entities.OVERLAY.path(state),
            *(entities.IMAGE_MARK.path(name, state) for name in cameras),
        ):
            radius = rr.Radius.ui_points(1.75)
            lines = rr.LineStrips2D.from_fields(colors=[color], radii=radius, draw_order=36.0)
            to.static(flat, lines)
            log_name_style(to, flat, 37.0)


def log_marks(to: Writer, result: FrameResult, marks: Sequence[Mark]) -> None:
    """Log the marks of a frame in space, in the images and over the bird's-eye image."""
    if not marks:
        return
    pose = transform(result.frame.pose)
    order = np.array([not mark.name for mark in marks])  # names first
    has_name = choose_named_in_3d(np.stack([mark.center for mark in marks]), ~order)
    for state in MARK_COLORS:
        rows = [row for row, mark in enumerate(marks) if mark.state == state]
        if not rows:
            continue
        path, chosen = entities.MARKED.path(state), [marks[row] for row in rows]
        lines = [_styled(state, mark.corners[np.array(_edges(mark))]) for mark in chosen]
        to.put(path, pose, rr.LineStrips3D(np.concatenate(lines)), _tooltips(chosen, lines))
        named = [marks[row] for row in rows if has_name[row] and marks[row].name]
        if named:
            places = np.stack([mark.center for mark in named]) + np.array([0, 0, 0.3], np.float32)
            words = rr.Points3D(places, labels=[mark.name for mark in named])
            to.put(
                entities.NAMES.path(path), pose, words, rr.AnyValues(says=[mark.sentence for mark in named])
            )
        _log_above(to, state, chosen, result.config.bev)
    for camera in result.cameras:
        _log_in_image(to, camera.camera, [mark for mark in marks if mark.box is not None])


def _log_above(to: Writer, state: MarkState, marks: Sequence[Mark], config: BevConfig) -> None:
    """Log the marks over the bird's-eye image, if their centre is in it."""
    reach = np.array([config.range_x, config.range_y], np.float32)
    inside = [mark for mark in marks if (np.abs(mark.center[:2]) < reach).all()]
    if inside:
        corners = np.stack([mark.corners for mark in inside])
        pixels = bev_pixels(config, np.eye(4), corners)
        rim = (*_SIDES, *_FLAT_CROSS) if state == "false" else _SIDES
        lines = [
            _styled(state, row[np.array(rim if mark.box is not None else _WEDGE)])
            for mark, row in zip(inside, pixels, strict=True)
        ]
        to.put(entities.OVERLAY.path(state), rr.LineStrips2D(np.concatenate(lines)), _tooltips(inside, lines))


def _log_in_image(to: Writer, camera: Camera, marks: Sequence[Mark]) -> None:
    """Log the marks over an image, the first with names that do not overlap."""
    if camera.intrinsics is None or not marks:
        return
    boxes = Boxes3D.joined([mark.box for mark in marks if mark.box is not None])
    outlines = image_outlines(boxes, camera)
    drawn = [(mark, stroke) for mark, stroke in zip(marks, outlines, strict=True) if len(stroke)]
    if not drawn:
        return
    width, (across, up) = camera.intrinsics.width, IN_IMAGE
    # Names stand above the objects, because detections have theirs below.
    tops = [(stroke[:, 0].mean(), max(stroke[:, 1].min() - up * width, 0)) for _, stroke in drawn]
    places = np.array(tops, np.float32)
    letters = np.array([len(mark.name) for mark, _ in drawn], np.float64)
    distances = np.array([np.hypot(*mark.center[:2]) for mark, _ in drawn], np.float32)
    room = (np.maximum(across, LETTER_WIDTH * letters), up)
    has_name = choose_named(places / width, distances, room, letters > 0)
    for state in MARK_COLORS:
        rows = [row for row, (mark, _) in enumerate(drawn) if mark.state == state]
        if not rows:
            continue
        lines = []
        for row in rows:
            # All edges of a box would be one blot where the object is small.
            stroke = drawn[row][1] + np.float32(CORNER)
            (x0, y0), (x1, y1) = stroke.min(axis=0), stroke.max(axis=0)
            corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], np.float32)
            rim = (*_SIDES, *_FLAT_CROSS) if state == "false" else _SIDES
            lines.append(_styled(state, corners[np.array(rim)]))
        path, chosen = entities.IMAGE_MARK.path(camera.name, state), [drawn[row][0] for row in rows]
        to.put(path, rr.LineStrips2D(np.concatenate(lines)), _tooltips(chosen, lines))
        named = [row for row in rows if has_name[row] and drawn[row][0].name]
        if named:
            words = rr.Points2D(places[named], labels=[drawn[row][0].name for row in named])
            sentences = rr.AnyValues(says=[drawn[row][0].sentence for row in named])
            to.put(entities.NAMES.path(path), words, sentences)


def _edges(mark: Mark) -> Lines:
    """Return the lines of a mark in space, as pairs of corners."""
    if mark.box is None:
        return _WEDGE
    return (*_BOX, *_CROSS) if mark.state == "false" else _BOX


def _styled(state: MarkState, lines: F32) -> F32:
    """Cut (L, 2, D) lines into the dashes of a state: (L * dashes, 2, D)."""
    count = _DASHES[state]
    starts = np.arange(count, dtype=np.float32) / count
    ends = starts + np.float32((1 - _GAP if count > 1 else 1) / count)
    shares = np.stack([starts, ends], axis=1)[None, :, :, None]  # (1, dashes, 2, 1)
    first, last = lines[:, None, None, 0], lines[:, None, None, 1]
    dashes = first + shares * (last - first)
    return np.asarray(dashes.reshape(-1, 2, lines.shape[-1]), np.float32)


def _tooltips(marks: Sequence[Mark], lines: Sequence[F32]) -> rr.AnyValues:
    """Return a sentence for each line of the marks."""
    sentences = [mark.sentence for mark, dashes in zip(marks, lines, strict=True) for _ in dashes]
    return rr.AnyValues(says=sentences)
