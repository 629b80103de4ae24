"""Mark objects in every view: missed, false, and unexplained where there is no ground truth.

Each state has a line style besides its colour: missed objects are dashed, false ones are crossed out, and
unexplained ones are dotted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
import rerun as rr

from bevviz.model import geometry
from bevviz.model.frame import F32, Boxes3D, Camera
from bevviz.model.results import FrameResult
from bevviz.recording import entities
from bevviz.recording.labels import NameRoom, choose_named_in_3d, shown
from bevviz.recording.layers import Layer, Style, draw, name_layers, rectangles
from bevviz.recording.primitives import CORNER, transform
from bevviz.recording.projection import bev_pixels, bounds_of, image_outlines
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
_FLAT = Style(width=1.75, order=36.0)  # look over an image and the bird's-eye image
_GAP = 0.45  # share of a dash that is its gap
# Lines between the corners of a box: all edges, the cross on its top, the rim seen from above.
_BOX: Lines = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
_CROSS: Lines = ((4, 6), (5, 7))
_FLAT_CROSS: Lines = ((0, 2), (1, 3))
_SIDES: Lines = _BOX[:4]
_RIMS: Mapping[MarkState, Lines] = {
    "missed": _SIDES,
    "false": (*_SIDES, *_FLAT_CROSS),
    "unexplained": _SIDES,
}
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


def log_marks(to: Writer, result: FrameResult, marks: Sequence[Mark]) -> None:
    """Log the marks of a frame in space, in the images and over the bird's-eye image."""
    if not marks:
        return
    config, pose = result.config.bev, transform(result.frame.pose)
    centers = np.stack([mark.center for mark in marks])
    has_name = choose_named_in_3d(centers, np.array([bool(mark.name) for mark in marks]))
    reach = np.array([config.range_x, config.range_y], np.float32)
    above = np.asarray((np.abs(centers[:, :2]) < reach).all(axis=1), np.bool_)
    pixels = bev_pixels(config, np.eye(4), np.stack([mark.corners for mark in marks]))
    for state in MARK_COLORS:
        rows = [row for row, mark in enumerate(marks) if mark.state == state]
        chosen = [marks[row] for row in rows]
        lines = [mark.corners[np.array(_edges(mark))] for mark in chosen]
        names = shown([mark.name for mark in chosen], has_name[rows])
        places = centers[rows] + np.array([0, 0, 0.3], np.float32)
        _draw(to, entities.MARKED.path(state), state, chosen, lines, names, places, Style(width=2.0), pose)
        rows = [row for row in rows if above[row]]
        chosen = [marks[row] for row in rows]
        lines = [
            pixels[row][np.array(_WEDGE if mark.box is None else _RIMS[state])]
            for row, mark in zip(rows, chosen, strict=True)
        ]
        _draw(to, entities.OVERLAY.path(state), state, chosen, lines)
    for camera in result.cameras:
        _log_in_image(to, camera.camera, [mark for mark in marks if mark.box is not None])


def _log_in_image(to: Writer, camera: Camera, marks: Sequence[Mark]) -> None:
    """Log the marks over an image, the first with names that do not overlap."""
    if camera.intrinsics is None or not marks:
        return
    boxes = Boxes3D.joined([mark.box for mark in marks if mark.box is not None])
    strokes = image_outlines(boxes, camera)
    visible = [row for row, stroke in enumerate(strokes) if len(stroke)]
    marks, bounds = [marks[row] for row in visible], bounds_of([strokes[row] for row in visible])
    room = NameRoom.in_image(camera.intrinsics.width)
    # Names stand above the objects, because detections have theirs below.
    names, places = [mark.name for mark in marks], room.over(bounds)
    is_named = np.array([bool(name) for name in names], np.bool_)
    names = shown(names, room.choose(places, names, boxes.distance[visible], is_named))
    # All edges of a box would be one blot where the object is small.
    corners = rectangles(bounds + CORNER)
    for state in MARK_COLORS:
        rows = [row for row, mark in enumerate(marks) if mark.state == state]
        lines = [corners[row][np.array(_RIMS[state])] for row in rows]
        path, chosen = entities.IMAGE_MARK.path(camera.name, state), [marks[row] for row in rows]
        _draw(to, path, state, chosen, lines, [names[row] for row in rows], places[rows])


def _draw(
    to: Writer,
    path: str,
    state: MarkState,
    marks: Sequence[Mark],
    lines: Sequence[F32],
    names: Sequence[str] = (),
    places: F32 | None = None,
    style: Style = _FLAT,
    frame: rr.AsComponents | None = None,
) -> None:
    """Draw marks with the dashes of their state, and the names that are not empty."""
    if not marks:
        return
    dashes = [_styled(state, mark_lines) for mark_lines in lines]
    says = [mark.sentence for mark, strokes in zip(marks, dashes, strict=True) for _ in strokes]
    style = replace(style, color=MARK_COLORS[state])
    draw(to, Layer(path, np.concatenate(dashes), style, says=says, frame=frame))
    named = [row for row, name in enumerate(names) if name]
    if places is not None and named:
        texts, sentences = [names[row] for row in named], [marks[row].sentence for row in named]
        draw(to, *name_layers(path, places[named], texts, sentences, style.order, frame=frame))


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
