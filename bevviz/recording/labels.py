"""Log outlines and names over boxes, so that the viewer's tooltip shows one sentence.

The tooltip shows the values of a component only if at most three components differ from row to row. Otherwise
it shows their number. A box has five such components. So bevviz logs outlines and names over the boxes. Each
has a shape, a colour or a name, and a sentence. Their rows equal the rows of the boxes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from bevviz.model import geometry
from bevviz.model.frame import F32, F64, Bool, Boxes3D
from bevviz.recording import entities
from bevviz.recording.primitives import CORNER, edges, strips
from bevviz.recording.writer import Writer
from bevviz.support.colors import Color

MAX_NAMES = 6  # boxes with a name; names of all boxes would cover the scene
EYE, LOOK_TARGET = (-16.0, 5.0, 11.0), (10.0, 0.0, -1.0)  # default eye position and look target in 3D
# Size of a name, across and up: as tangents of the view angle in 3D, in metres from above, and as fractions
# of the image width in an image. Two names must be further apart than this in one direction.
IN_SPACE, FROM_ABOVE, IN_IMAGE = (0.24, 0.045), (20.0, 3.5), (0.21, 0.05)
LETTER_WIDTH = 0.014  # width of a letter in an image, as a fraction of the image width; for longer names

_INVISIBLE, _COLOR = rr.Radius.ui_points(0.0), (235, 238, 245)


def log_box_label_style(to: Writer, path: str) -> None:
    """Log the static style of outlines and names of 3D boxes."""
    to.static(entities.OUTLINES.path(path), rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(2.5)))
    to.static(
        entities.NAMES.path(path),
        rr.Points3D.from_fields(radii=_INVISIBLE, colors=[_COLOR], show_labels=True),
    )


def log_image_box_label_style(to: Writer, path: str, draw_order: float) -> None:
    """Log the static style of outlines and names of boxes in an image."""
    lines = rr.LineStrips2D.from_fields(radii=rr.Radius.ui_points(1.5), draw_order=draw_order)
    to.static(entities.OUTLINES.path(path), lines)
    log_name_style(to, path, draw_order + 1)


def log_name_style(to: Writer, path: str, draw_order: float) -> None:
    """Log the static style of names in an image."""
    points = rr.Points2D.from_fields(
        radii=_INVISIBLE, colors=[_COLOR], show_labels=True, draw_order=draw_order
    )
    to.static(entities.NAMES.path(path), points)


def log_box_labels(
    to: Writer,
    path: str,
    boxes: Boxes3D,
    names: Sequence[str],
    sentences: Sequence[str],
    colors: Sequence[Color],
) -> None:
    """Log outlines and names over the (K,) boxes at ``path``, in the frame of the boxes.

    Args:
        to: writer of the recording.
        path: entity of the boxes.
        boxes: boxes, in the order of their rows.
        names: text next to each box; empty: no text.
        sentences: tooltip of each box.
        colors: colour of each outline.
    """
    rows, tooltips = _logged_rows(len(boxes)), rr.AnyValues(says=_repeat_single(sentences))
    lines = edges(geometry.corners(boxes))[rows]
    to.put(
        entities.OUTLINES.path(path), rr.LineStrips3D(lines, colors=[colors[row] for row in rows]), tooltips
    )
    if any(names):
        tops = boxes.center + boxes.size * np.array([0, 0, 0.5], np.float32)
        to.put(entities.NAMES.path(path), rr.Points3D(tops[rows], labels=_repeat_single(names)), tooltips)


def log_image_box_labels(
    to: Writer, path: str, xyxy: F32, names: Sequence[str], sentences: Sequence[str], colors: Sequence[Color]
) -> None:
    """Log outlines and names over boxes in an image. ``xyxy``: (K, 4) pixels in bevviz's convention."""
    rows, tooltips = _logged_rows(len(xyxy)), rr.AnyValues(says=_repeat_single(sentences))
    corners = (xyxy + CORNER)[rows][:, [0, 1, 2, 1, 2, 3, 0, 3, 0, 1]].reshape(-1, 5, 2)
    to.put(
        entities.OUTLINES.path(path), rr.LineStrips2D(corners, colors=[colors[row] for row in rows]), tooltips
    )
    if any(names):
        to.put(
            entities.NAMES.path(path),
            rr.Points2D((corners[:, 2] + corners[:, 3]) / 2, labels=_repeat_single(names)),
            tooltips,
        )


def log_labelled_outlines(
    to: Writer, path: str, strokes: Sequence[F32], names: Sequence[str], sentences: Sequence[str], places: F32
) -> None:
    """Log (K,) outlines of (M, 2) pixels with a sentence each, and names at (K, 2) ``places``."""
    rows, tooltips = _logged_rows(len(strokes)), rr.AnyValues(says=_repeat_single(sentences))
    lines = [strokes[row] for row in rows]
    to.put(path, rr.LineStrips2D(strips(np.concatenate(lines), np.array([*map(len, lines)]))), tooltips)
    if any(names):
        to.put(entities.NAMES.path(path), rr.Points2D(places[rows], labels=_repeat_single(names)), tooltips)


def box_row(instance: int, count: int) -> int:
    """Return the row of the box for an instance of outlines or names. A single box has two instances."""
    return 0 if count == 1 and instance in (0, 1) else instance


def choose_named_in_3d(places: F32 | F64, first: Bool | None = None, height: float = 1.0) -> Bool:
    """Choose the 3D boxes that get a name: the nearest ones, as long as names do not overlap.

    Args:
        places: (K, 3) positions around the robot.
        first: (K,) mask of positions that come before nearer ones.
        height: height of the view as a fraction of its usual height.

    Returns:
        (K,) mask.
    """
    ahead = np.subtract(LOOK_TARGET, EYE)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    eye_positions = (places - np.array(EYE)) @ np.stack([right, np.cross(right, ahead), ahead], axis=1)
    tangents = eye_positions[:, :2] / np.maximum(eye_positions[:, 2:], 0.1)
    return choose_named(tangents, _distances(places), (IN_SPACE[0] / height, IN_SPACE[1] / height), first)


def choose_named(
    at: geometry.FloatArray, order: F32, room: tuple[float | F64, float], first: Bool | None = None
) -> Bool:
    """Choose the first ``MAX_NAMES`` names that do not overlap. Return a (K,) mask.

    Args:
        at: (K, 2) positions of the names, across and up.
        order: (K,) sort key; the smallest comes first.
        room: size of a name: width, one for all or (K,), and height.
        first: (K,) mask of names that come before all others.
    """
    chosen: list[tuple[float, float, float]] = []
    widths = np.broadcast_to(room[0], len(at)).tolist()
    mask: Bool = np.zeros(len(at), bool)
    rows = np.lexsort((order, ~first)) if first is not None else np.argsort(order, kind="stable")
    positions = at.tolist()
    for row in rows.tolist():
        x, y = positions[row]
        if all(
            abs(x - other_x) >= (widths[row] + other_width) / 2 or abs(y - other_y) >= room[1]
            for other_x, other_y, other_width in chosen
        ):
            mask[row] = True
            chosen.append((x, y, widths[row]))
            if len(chosen) == MAX_NAMES:
                break
    return mask


def _distances(places: F32 | F64) -> F32:
    distances: F32 = np.hypot(places[:, 0], places[:, 1])
    return distances


def _logged_rows(count: int) -> list[int]:
    """Return the rows to log. A single row is repeated.

    The viewer takes a component with one row for a value of all rows, and shows only its number.
    """
    return list(range(count)) if count > 1 else [0, 0]


def _repeat_single(texts: Sequence[str]) -> list[str]:
    return [*texts] if len(texts) > 1 else [*texts, *texts]
