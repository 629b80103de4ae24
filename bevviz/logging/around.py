"""What the robot says around its perception: marks, its diagnostics, shapes in the world."""

from __future__ import annotations

from collections.abc import Sequence

import rerun as rr

from bevviz import geometry
from bevviz.frame import Around, Frame, Grid, Shape, Status
from bevviz.logging import entities
from bevviz.logging.pieces import transform
from bevviz.logging.writer import Writer

LANES = 40  # of the robot's diagnostics; the worst
_WORST = ("error", "stale", "warning", "ok")
_PARTS = ("points", "strips", "solids", "axes", "grid", "fix", "picture")
_COLOR = (120, 200, 255)


def log_shapes(to: Writer, frame: Frame) -> None:
    """What has a place in the world."""
    for shape in (frame.around or Around()).shapes:
        flat = shape.fix is not None or shape.picture is not None
        if flat or shape.world_from_shape is not None:
            _log_shape(to, shape)


class AroundLog:
    """Remembers what the diagnostics said."""

    def __init__(self) -> None:
        self._said: dict[str, str] = {}  # by name of the status

    def lines(self, frame: Frame) -> list[tuple[str, str]]:
        """Marks and news of the diagnostics as lines of the log: level and text."""
        return [*marks(frame), *self._news((frame.around or Around()).statuses)]

    def _news(self, statuses: Sequence[Status]) -> list[tuple[str, str]]:
        """What the robot's diagnostics say that they did not say before; at first what is not well."""
        lines = []
        for status in statuses:
            text = f"{status.name}: {status.level}{f', {status.text}' if status.text else ''}"
            before = self._said.get(status.name)
            if text != before and not (before is None and status.level == "ok"):
                level = {"ok": "INFO", "error": "ERROR"}.get(status.level, "WARN")
                lines.append((level, f"diagnostics: {text}"))
            self._said[status.name] = text
        return lines


def diagnostic_states(frame: Frame) -> dict[str, str]:
    """State lane -> level of what the robot's diagnostics say, the worst of them."""
    statuses = frame.around.statuses if frame.around else ()
    shown = sorted(statuses, key=lambda status: _WORST.index(status.level))[:LANES]
    return {entities.diagnostic(status.name): status.level for status in shown}


def marks(frame: Frame) -> list[tuple[str, str]]:
    """Notes of people at this frame, as lines of the log."""
    return [("INFO", f"mark: {text}") for text in (frame.around.marks if frame.around else ())]


def _log_shape(to: Writer, shape: Shape) -> None:
    path = entities.robot(shape.topic)
    version = hash((shape.stamp, *(id(getattr(shape, part)) for part in _PARTS)))
    color = [_COLOR if shape.color is None else shape.color.tolist()]
    if shape.world_from_shape is not None and shape.picture is None:
        to.write(path, transform(shape.world_from_shape))
    if to.keep(path, version):
        return
    if shape.points is not None:
        to.put(path, rr.Points3D(shape.points, colors=color, radii=rr.Radius.ui_points(2)))
    if shape.strips:
        to.put(path, rr.LineStrips3D(shape.strips, colors=color, radii=rr.Radius.ui_points(2)))
    if shape.axes is not None:
        place, turn = shape.axes[:3, 3], shape.axes[:3, :3]
        to.put(path, rr.Arrows3D(origins=[place], vectors=[turn[:, 0]], colors=color))
    if shape.grid is not None:
        to.put(path, _grid(shape.grid))
    if shape.picture is not None:
        to.put(path, rr.Image(shape.picture, color_model="BGR"))
    if shape.fix is not None:
        to.put(path, rr.GeoPoints(lat_lon=[shape.fix], colors=color, radii=rr.Radius.ui_points(6)))
    if (solids := shape.solids) is not None:
        kind = rr.Ellipsoids3D if solids.round else rr.Boxes3D
        labels = [shape.text] if shape.text else None
        to.put(
            path,
            kind(
                centers=solids.center,
                half_sizes=solids.half,
                quaternions=solids.quaternion,
                colors=color,
                labels=labels,
                show_labels=bool(labels),
            ),
        )


def _grid(grid: Grid) -> rr.GridMap:
    rows, columns = grid.cells.shape
    return rr.GridMap(
        data=grid.cells[::-1].tobytes(),
        format=rr.components.ImageFormat(width=columns, height=rows, color_model="L", channel_datatype="U8"),
        cell_size=grid.resolution,
        translation=grid.pose[:3, 3],
        quaternion=rr.Quaternion(xyzw=geometry.quaternion(grid.pose)),
        colormap=rr.components.Colormap.RvizMap,
        opacity=0.6,  # what is below stays seen
    )
