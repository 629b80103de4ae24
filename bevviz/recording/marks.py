"""Mark objects in every view: missed, false, and unexplained or unnamed where there is no ground truth.

Each state has a line style besides its colour: missed objects are dashed, false ones are crossed out, and
unexplained and unnamed ones are dotted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import rerun as rr

from bevviz.model.frame import F32, Boxes3D, Camera
from bevviz.model.results import FrameResult
from bevviz.recording import entities
from bevviz.recording.addresses import Address, Rows
from bevviz.recording.labels import NameRoom, choose_named_in_3d, shown
from bevviz.recording.layers import Layer, Style, draw, name_layers, rectangles
from bevviz.recording.primitives import CORNER, transform
from bevviz.recording.projection import bev_pixels, bounds_of, image_outlines
from bevviz.recording.writer import Writer
from bevviz.support.colors import Color, StateColor

Lines: TypeAlias = tuple[tuple[int, int], ...]  # pairs of corners
MarkState: TypeAlias = Literal["missed", "false", "unexplained", "unnamed"]

MARK_COLORS: Mapping[MarkState, Color] = {
    "missed": StateColor.BAD.value,
    "false": StateColor.DOUBTFUL.value,
    "unexplained": StateColor.DOUBTFUL.value,
    "unnamed": StateColor.UNKNOWN.value,
}
_DASHES: Mapping[MarkState, int] = {
    "missed": 4,
    "false": 1,
    "unexplained": 8,
    "unnamed": 8,
}  # dashes of each line
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
    "unnamed": _SIDES,
}
_WEDGE: Lines = ((0, 4), (1, 5), (2, 6), (3, 7), (4, 5), (5, 6), (6, 7), (7, 4))  # of a frustum


@dataclass(frozen=True, slots=True)
class Mark:
    """Marked object.

    Attributes:
        state: missed, false, unexplained or unnamed.
        name: text beside it; empty: no text.
        sentence: text of the tooltip.
        corners: (8, 3) corners of its box or of its frustum, around the robot.
        address: row of the frame's tables that it marks.
        box: its box, as one row; None: a detection without a position, marked by its frustum.
    """

    state: MarkState
    name: str
    sentence: str
    corners: F32
    address: Address
    box: Boxes3D | None = None

    @property
    def center(self) -> F32:
        """(3,) position of the name: the top of a box, or the far end of a frustum."""
        points = self.corners[4:]
        return np.asarray(points.mean(axis=0), np.float32)


def log_marks(to: Writer, result: FrameResult, marks: Sequence[Mark], *, dashed: bool = True) -> None:
    """Log the marks of a frame in space, in the images and over the bird's-eye image.

    Args:
        to: writer of the recording.
        result: result of the frame.
        marks: marks to log.
        dashed: draw the dashes of each state. Without them a line can be clicked everywhere.
    """
    if not marks:
        return
    config, pose = result.config.bev, transform(result.frame.pose)
    drawn = _MarkDrawer(to, marks, dashed)
    centers = np.stack([mark.center for mark in marks])
    has_name = choose_named_in_3d(centers, np.array([bool(mark.name) for mark in marks]))
    names = shown([mark.name for mark in marks], has_name)
    places = centers + np.array([0, 0, 0.3], np.float32)
    reach = np.array([config.range_x, config.range_y], np.float32)
    above = np.asarray((np.abs(centers[:, :2]) < reach).all(axis=1), np.bool_)
    pixels = bev_pixels(config, np.eye(4), np.stack([mark.corners for mark in marks]))
    for state in MARK_COLORS:
        rows = [row for row, mark in enumerate(marks) if mark.state == state]
        lines = [marks[row].corners[np.array(_edges(marks[row]))] for row in rows]
        style = Style(width=2.0)
        drawn.draw(entities.MARKED.path(state), state, rows, lines, names, places, style, pose)
        rows = [row for row in rows if above[row]]
        rims = [_WEDGE if marks[row].box is None else _RIMS[state] for row in rows]
        lines = [pixels[row][np.array(rim)] for row, rim in zip(rows, rims, strict=True)]
        drawn.draw(entities.OVERLAY.path(state), state, rows, lines)
    for camera in result.cameras:
        _log_in_image(drawn, camera.camera, marks)


def _log_in_image(drawn: _MarkDrawer, camera: Camera, marks: Sequence[Mark]) -> None:
    """Log the marks with a box over an image, the first with names that do not overlap."""
    boxed = [(row, mark.box) for row, mark in enumerate(marks) if mark.box is not None]
    if camera.intrinsics is None or not boxed:
        return
    boxes = Boxes3D.joined([box for _, box in boxed])
    strokes = image_outlines(boxes, camera)
    visible = [i for i, stroke in enumerate(strokes) if len(stroke)]
    bounds = bounds_of([strokes[i] for i in visible])
    room = NameRoom.in_image(camera.intrinsics.width)
    # Names stand above the objects, because detections have theirs below.
    rows, places = [boxed[i][0] for i in visible], room.over(bounds)
    texts = [marks[row].name for row in rows]
    has_text = np.array([bool(text) for text in texts], np.bool_)
    texts = shown(texts, room.choose(places, texts, boxes.distance[visible], has_text))
    # All edges of a box would be one blot where the object is small.
    corners = dict(zip(rows, rectangles(bounds + CORNER), strict=True))
    names, positions = [""] * len(marks), np.zeros((len(marks), 2), np.float32)
    for row, text, place in zip(rows, texts, places, strict=True):
        names[row], positions[row] = text, place
    for state in MARK_COLORS:
        chosen = [row for row in rows if marks[row].state == state]
        lines = [corners[row][np.array(_RIMS[state])] for row in chosen]
        drawn.draw(entities.IMAGE_MARK.path(camera.name, state), state, chosen, lines, names, positions)


class _MarkDrawer:
    """Drawer of the marks of a frame.

    Args:
        to: writer of the recording.
        marks: marks of the frame.
        dashed: whether to draw dashes.
    """

    def __init__(self, to: Writer, marks: Sequence[Mark], dashed: bool) -> None:
        self._to, self._marks, self._dashed = to, marks, dashed

    def draw(
        self,
        path: str,
        state: MarkState,
        rows: Sequence[int],
        lines: Sequence[F32],
        names: Sequence[str] = (),
        places: F32 | None = None,
        style: Style = _FLAT,
        frame: rr.AsComponents | None = None,
    ) -> None:
        """Draw marks with the dashes of their state, and the names that are not empty.

        Args:
            path: entity.
            state: state of these marks.
            rows: rows of these marks.
            lines: lines of each of them.
            names: names of all marks.
            places: positions of all names.
            style: look of the lines.
            frame: pose of the marks.
        """
        if not rows:
            return
        count = _DASHES[state] if self._dashed else 1
        dashes = [_dashed(mark_lines, count) for mark_lines in lines]
        instances = [row for row, strokes in zip(rows, dashes, strict=True) for _ in strokes]
        says = [self._marks[row].sentence for row in instances]
        # Not static: the workbench dims what is not asked about.
        colors = [MARK_COLORS[state]] * len(instances)
        addresses = self._addresses(instances)
        strokes = np.concatenate(dashes)
        layer = Layer(path, strokes, style, says=says, colors=colors, frame=frame, rows=addresses)
        draw(self._to, layer)
        named = [row for row in rows if names and names[row]]
        if places is not None and named:
            texts, sentences = [names[row] for row in named], [self._marks[row].sentence for row in named]
            addresses, order = self._addresses(named), style.order
            layers = name_layers(path, places[named], texts, sentences, order, frame=frame, rows=addresses)
            draw(self._to, *layers)

    def _addresses(self, rows: Sequence[int]) -> Rows:
        """Return the rows of the frame's tables that marks are of."""
        tables, table_rows, cameras = zip(*(self._marks[row].address for row in rows), strict=True)
        return Rows(tables, table_rows, cameras)


def _edges(mark: Mark) -> Lines:
    """Return the lines of a mark in space, as pairs of corners."""
    if mark.box is None:
        return _WEDGE
    return (*_BOX, *_CROSS) if mark.state == "false" else _BOX


def _dashed(lines: F32, count: int) -> F32:
    """Cut (L, 2, D) lines into dashes: (L * count, 2, D)."""
    starts = np.arange(count, dtype=np.float32) / count
    ends = starts + np.float32((1 - _GAP if count > 1 else 1) / count)
    shares = np.stack([starts, ends], axis=1)[None, :, :, None]  # (1, dashes, 2, 1)
    first, last = lines[:, None, None, 0], lines[:, None, None, 1]
    dashes = first + shares * (last - first)
    return np.asarray(dashes.reshape(-1, 2, lines.shape[-1]), np.float32)
