"""Boxes that say what they are: outlines and names whose tooltip in the viewer is one sentence.

The viewer's tooltip shows the values of what is hovered over where at most three differ from row to row, and
only counts them otherwise. A box has five. So over the boxes, which have all that is known, lie outlines and
names that have no more than a shape, a colour or a name, and a sentence; their rows are those of the boxes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr

from bevviz.model import geometry
from bevviz.model.colors import Color
from bevviz.model.frame import F32, F64, Bool, Boxes3D
from bevviz.recording import entities
from bevviz.recording.primitives import CORNER, edges, strips
from bevviz.recording.writer import Writer

NEAR = 6  # boxes that have their names beside them because they are near: with all, names cover the scene
EYE, LOOK = (-16.0, 5.0, 11.0), (10.0, 0.0, -1.0)  # from where the layouts look into space, and whereto
# The room of a name, across and up: in space as the eye sees it (tangents), from above in metres, in an image
# in parts of its width, as views are narrow. What is named must be further apart than one of the two.
IN_SPACE, FROM_ABOVE, IN_IMAGE = (0.24, 0.035), (20.0, 3.5), (0.21, 0.05)
LETTER = 0.014  # of a longer name in an image: part of its width

_POINT, _COLOR = rr.Radius.ui_points(0.0), (235, 238, 245)


def log_spoken_looks(to: Writer, path: str) -> None:
    """Of boxes in space."""
    to.static(entities.outlines(path), rr.LineStrips3D.from_fields(radii=rr.Radius.ui_points(2.5)))
    to.static(entities.names(path), rr.Points3D.from_fields(radii=_POINT, colors=[_COLOR], show_labels=True))


def log_spoken_looks_in_image(to: Writer, path: str, draw_order: float) -> None:
    lines = rr.LineStrips2D.from_fields(radii=rr.Radius.ui_points(1.5), draw_order=draw_order)
    to.static(entities.outlines(path), lines)
    log_names_looks(to, path, draw_order + 1)


def log_names_looks(to: Writer, path: str, draw_order: float) -> None:
    """Of what is written beside things in an image."""
    points = rr.Points2D.from_fields(radii=_POINT, colors=[_COLOR], show_labels=True, draw_order=draw_order)
    to.static(entities.names(path), points)


def log_spoken(
    to: Writer,
    path: str,
    boxes: Boxes3D,
    names: Sequence[str],
    sentences: Sequence[str],
    colors: Sequence[Color],
) -> None:
    """Outlines and names over the (K,) boxes at ``path``, in whose frame they are.

    Args:
        to: where to.
        path: of the boxes.
        boxes: that have rows there.
        names: what is written beside them; empty: nothing.
        sentences: of the tooltips.
        colors: of the outlines.
    """
    rows, words = _rows(len(boxes)), rr.AnyValues(says=_filled(sentences))
    lines = edges(geometry.corners(boxes))[rows]
    to.put(entities.outlines(path), rr.LineStrips3D(lines, colors=[colors[row] for row in rows]), words)
    if any(names):
        tops = boxes.center + boxes.size * np.array([0, 0, 0.5], np.float32)
        to.put(entities.names(path), rr.Points3D(tops[rows], labels=_filled(names)), words)


def log_spoken_in_image(
    to: Writer, path: str, xyxy: F32, names: Sequence[str], sentences: Sequence[str], colors: Sequence[Color]
) -> None:
    """The same in an image. ``xyxy``: (K, 4) in pixels as bevviz counts them."""
    rows, words = _rows(len(xyxy)), rr.AnyValues(says=_filled(sentences))
    corners = (xyxy + CORNER)[rows][:, [0, 1, 2, 1, 2, 3, 0, 3, 0, 1]].reshape(-1, 5, 2)
    to.put(entities.outlines(path), rr.LineStrips2D(corners, colors=[colors[row] for row in rows]), words)
    if any(names):
        to.put(
            entities.names(path),
            rr.Points2D((corners[:, 2] + corners[:, 3]) / 2, labels=_filled(names)),
            words,
        )


def log_stroked(
    to: Writer, path: str, strokes: Sequence[F32], names: Sequence[str], sentences: Sequence[str], places: F32
) -> None:
    """The same of (K,) things that are lines themselves, of (M, 2) pixels; names at (K, 2) ``places``."""
    rows, words = _rows(len(strokes)), rr.AnyValues(says=_filled(sentences))
    chosen = [strokes[row] for row in rows]
    to.put(path, rr.LineStrips2D(strips(np.concatenate(chosen), np.array([*map(len, chosen)]))), words)
    if any(names):
        to.put(entities.names(path), rr.Points2D(places[rows], labels=_filled(names)), words)


def row_of(instance: int, count: int) -> int:
    """What a row of outlines or names stands for; see ``_rows``."""
    return 0 if count == 1 and instance in (0, 1) else instance


def named_in_space(places: F32 | F64, first: Bool | None = None, height: float = 1.0) -> Bool:
    """(K,) those of (K, 3) places around the robot that are named: the nearest, as far as names do not meet.

    ``first``: (K,) come before what is near; ``height``: of the view, of what it has beside others usually.
    """
    ahead = np.subtract(LOOK, EYE)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    seen = (places - np.array(EYE)) @ np.stack([right, np.cross(right, ahead), ahead], axis=1)
    at = seen[:, :2] / np.maximum(seen[:, 2:], 0.1)
    return apart(at, _away(places), (IN_SPACE[0] / height, IN_SPACE[1] / height), first)


def named_from_above(places: F32) -> Bool:
    """The same, seen from above; (K, 2 or 3) places around the robot, x ahead."""
    return apart(places[:, 1::-1], _away(places), FROM_ABOVE)


def apart(
    at: geometry.FloatArray, order: F32, room: tuple[float | F64, float], first: Bool | None = None
) -> Bool:
    """(K,) the first ``NEAR`` whose names do not meet.

    Args:
        at: (K, 2) where the names are, across and up.
        order: (K,) the least comes first.
        room: of a name, across, one for all or (K,), and up.
        first: (K,) come before all others.
    """
    chosen: list[tuple[float, float, float]] = []
    wide = np.broadcast_to(room[0], len(at)).tolist()
    found: Bool = np.zeros(len(at), bool)
    rows = np.lexsort((order, ~first)) if first is not None else np.argsort(order, kind="stable")
    places = at.tolist()
    for row in rows.tolist():
        x, y = places[row]
        if all(abs(x - u) >= (wide[row] + w) / 2 or abs(y - v) >= room[1] for u, v, w in chosen):
            found[row] = True
            chosen.append((x, y, wide[row]))
            if len(chosen) == NEAR:
                break
    return found


def _away(places: F32 | F64) -> F32:
    away: F32 = np.hypot(places[:, 0], places[:, 1])
    return away


def _rows(count: int) -> list[int]:
    """A single one twice: the viewer takes what has one row for a value of all rows, and only counts it."""
    return list(range(count)) if count > 1 else [0, 0]


def _filled(texts: Sequence[str]) -> list[str]:
    return [*texts] if len(texts) > 1 else [*texts, *texts]
