"""Annotation layers: boxes, lines and points in space, in an image and from above, with names and sentences.

The viewer's tooltip shows the values of a component only if at most three components differ from row to row.
Otherwise it shows their number. A box has five such components. So outlines and names are drawn over the
boxes. Each has a shape, a colour or a name, and a sentence. Their rows equal the rows of the boxes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
import rerun as rr
from numpy.typing import ArrayLike

from bevviz.model import geometry
from bevviz.model.frame import F32, F64, Boxes3D
from bevviz.recording import entities
from bevviz.recording.addresses import Rows
from bevviz.recording.components import Components
from bevviz.recording.primitives import CORNER, strips
from bevviz.recording.projection import edges
from bevviz.recording.writer import Writer

Items: TypeAlias = Boxes3D | F32 | F64 | Sequence[F32]
Look: TypeAlias = tuple[int, ...]  # colour: red, green, blue, and opacity

NAME_COLOR = (235, 238, 245)


@dataclass(frozen=True, slots=True)
class Style:
    """Look of a layer. It is logged once, as static data.

    Attributes:
        color: colour by meaning; None: each item has its own.
        width: radius of lines and points in points of the screen; None: the viewer's choice.
        labels: whether labels are always shown; False: only under the pointer; None: the viewer's choice.
        order: order over an image; a higher one is in front.
        wire: whether boxes show edges only, also those of a single box.
    """

    color: Look | None = None
    width: float | None = None
    labels: bool | None = None
    order: float | None = None
    wire: bool = False

    @property
    def fields(self) -> dict[str, Any]:
        """Arguments of Rerun's archetypes."""
        fields = {
            "colors": None if self.color is None else [self.color],
            "radii": None if self.width is None else rr.Radius.ui_points(self.width),
            "show_labels": self.labels,
            "draw_order": self.order,
            "fill_mode": rr.components.FillMode.MajorWireframe if self.wire else None,
        }
        return {name: value for name, value in fields.items() if value is not None}


_NO_STYLE, _OUTLINE = Style(), Style(width=2.5)


@dataclass(frozen=True, slots=True)
class Layer:
    """Annotations of one kind in one view.

    Attributes:
        path: entity.
        items: boxes; (K, 4) boxes in an image, in bevviz's pixels; (K, 2) or (K, 3) points; lines of (M, 2)
            or (M, 3) points. Lines and points in an image are in Rerun's pixels.
        style: look of all items.
        labels: text of each item.
        says: sentence of each item, for the tooltip.
        colors: colour of each item.
        class_ids: class id of each item. The annotation context names and colours them.
        widths: as ``Style.width``, of each item.
        values: further columns.
        frame: pose of the items in the fixed frame; or name of the camera whose image they are drawn over.
        rows: rows of the frame's tables that the items show. None: a click is on a place.
    """

    path: str
    items: Items
    style: Style = field(default_factory=Style)
    labels: Sequence[str] | None = None
    says: Sequence[str] | None = None
    colors: ArrayLike | None = None
    class_ids: ArrayLike | None = None
    widths: Sequence[float] | None = None
    values: Mapping[str, Any] = field(default_factory=dict)
    frame: rr.AsComponents | str | None = None
    rows: Rows | None = None


def draw(to: Writer, *layers: Layer, put: Callable[..., None] | None = None) -> None:
    """Log layers. A layer without items is left out.

    Args:
        to: writer of the recording.
        layers: layers to log.
        put: ``to.write``, if the items remain until newer ones come; default: ``to.put``.
    """
    for layer in layers:
        if len(layer.items):
            _draw(to, layer, put or to.put)


def _draw(to: Writer, layer: Layer, put: Callable[..., None]) -> None:
    if layer.says is not None and len(layer.items) == 1 and not isinstance(layer.items, Boxes3D):
        layer = _doubled(layer)
    archetype, fields = _shapes(layer.items)
    columns = {"labels": layer.labels, "colors": layer.colors, "class_ids": layer.class_ids}
    fields |= {name: column for name, column in columns.items() if column is not None}
    if layer.widths is not None:
        fields["radii"] = rr.Radius.ui_points(layer.widths)
    values = dict(layer.values) if layer.says is None else {"says": layer.says, **layer.values}
    if (style := layer.style) != _NO_STYLE:
        to.static_once(layer.path, lambda: archetype.from_fields(**style.fields), archetype.__name__, style)
    if isinstance(layer.frame, str):
        _log_image_frame(to, layer.path, layer.frame)
    if layer.rows is not None:
        to.note_rows(layer.path, layer.rows)
    pose = [] if layer.frame is None or isinstance(layer.frame, str) else [layer.frame]
    put(layer.path, *pose, Components(archetype, fields, values))


def _shapes(items: Items) -> tuple[Any, dict[str, Any]]:
    """Return Rerun's archetype of the items, and its arguments."""
    if isinstance(items, Boxes3D):
        quaternions = np.zeros((len(items), 4), np.float32)
        quaternions[:, 2], quaternions[:, 3] = np.sin(items.yaw / 2), np.cos(items.yaw / 2)
        return rr.Boxes3D, {"half_sizes": items.size / 2, "centers": items.center, "quaternions": quaternions}
    if isinstance(items, np.ndarray) and items.ndim == 2:
        if items.shape[1] == 4:
            corners = items + CORNER
            centers = (corners[:, :2] + corners[:, 2:]) / 2
            return rr.Boxes2D, {"half_sizes": corners[:, 2:] - centers, "centers": centers}
        return (rr.Points2D if items.shape[1] == 2 else rr.Points3D), {"positions": items}
    if isinstance(items, np.ndarray):
        points, lengths = items.reshape(-1, items.shape[2]), np.full(len(items), items.shape[1])
    else:
        points, lengths = np.concatenate(items), np.array([len(line) for line in items])
    lines = strips(points.astype(np.float32, copy=False), lengths)
    return (rr.LineStrips2D if items[0].shape[1] == 2 else rr.LineStrips3D), {"strips": lines}


def _doubled(layer: Layer) -> Layer:
    """Return the layer with its single item drawn twice.

    The viewer takes a component with one row for a value of all rows, and shows only its number.
    """

    def twice(column: Any) -> Any:
        return None if column is None else [*column, *column]

    items = np.array(twice(layer.items), np.float32)
    labels, says, colors = map(twice, (layer.labels, layer.says, layer.colors))
    rows = None if layer.rows is None else layer.rows.doubled()
    return replace(layer, items=items, labels=labels, says=says, colors=colors, rows=rows)


def _log_image_frame(to: Writer, path: str, camera: str) -> None:
    """Draw an entity over a camera's image. An entity below the image is there already.

    The frame is static, because Rerun drops a frame that is logged at the time of a recursive clear.
    """
    image = entities.IMAGE.path(camera)
    if to.root or not path.startswith(f"{image}/"):
        to.static_once(path, lambda: rr.CoordinateFrame(entities.space(image)), image)


def callouts(
    path: str,
    boxes: Boxes3D | F32,
    says: Sequence[str],
    names: Sequence[str],
    colors: Sequence[Look],
    style: Style = _OUTLINE,
    frame: str | None = None,
    name_color: Look = NAME_COLOR,
    rows: Rows | None = None,
) -> Iterator[Layer]:
    """Yield the layers of outlines and names over the (K,) boxes at ``path``.

    Args:
        path: entity of the boxes.
        boxes: boxes, or (K, 4) boxes in an image.
        says: tooltip of each box.
        names: text next to each box; empty: no text.
        colors: colour of each outline.
        style: look of the outlines.
        frame: name of the camera, for boxes in an image.
        name_color: colour of all names.
        rows: as in ``Layer``.
    """
    if isinstance(boxes, Boxes3D):
        lines = edges(geometry.corners(boxes))
        places: F32 | F64 = boxes.center + boxes.size * np.array([0, 0, 0.5], np.float32)
    else:
        lines = rectangles(boxes + CORNER)
        places = (lines[:, 2] + lines[:, 3]) / 2
    yield Layer(entities.OUTLINES.path(path), lines, style, says=says, colors=colors, frame=frame, rows=rows)
    yield from name_layers(path, places, names, says, style.order, name_color, frame, rows)


def name_layers(
    path: str,
    places: F32 | F64,
    names: Sequence[str],
    says: Sequence[str],
    order: float | None = None,
    color: Look = NAME_COLOR,
    frame: rr.AsComponents | str | None = None,
    rows: Rows | None = None,
) -> Iterator[Layer]:
    """Yield the layer of the names next to items at ``path``; without names, there is none.

    Args:
        path: entity of the items.
        places: (K, 2) or (K, 3) positions.
        names: (K,) texts; empty: no text.
        says: (K,) tooltips.
        order: draw order of the items; names are in front of them.
        color: colour of all names.
        frame: as in ``Layer``.
        rows: as in ``Layer``.
    """
    if any(names):
        style = Style(color, 0.0, labels=True, order=None if order is None else order + 1)
        yield Layer(entities.NAMES.path(path), places, style, labels=names, says=says, frame=frame, rows=rows)


def rectangles(bounds: F32) -> F32:
    """Return (K, 5, 2) closed outlines of (K, 4) boxes."""
    return bounds[:, [0, 1, 2, 1, 2, 3, 0, 3, 0, 1]].reshape(-1, 5, 2)
