"""What the robot says around its perception: marks, its diagnostics, shapes in the world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np
import rerun as rr

from bevviz.model import geometry
from bevviz.model.colors import bins, turbo
from bevviz.model.frame import Around, Frame, Grid, MeshFile, Shape, Status, Surface
from bevviz.recording import entities
from bevviz.recording.primitives import transform
from bevviz.recording.writer import Writer

LANES = 40  # of the robot's diagnostics; the worst
_WORST = ("error", "stale", "warning", "ok")
_PARTS = ("points", "strips", "solids", "axes", "grid", "surface", "fix", "picture")
_TYPES = {".dae": "model/vnd.collada+xml"}  # that Rerun does not know by the name of the file
_AXES = {"x": (225, 75, 60), "y": (110, 190, 90), "z": (86, 150, 233)}

Fixed: TypeAlias = Sequence[rr.AsComponents]
_COLOR = (120, 200, 255)


def log_shapes(to: Writer, frame: Frame) -> None:
    """What has a place in the world."""
    for shape in (frame.around or Around()).shapes:
        flat = shape.fix is not None or shape.picture is not None
        if flat or shape.world_from_shape is not None:
            _log_shape(to, shape)
        elif shape.meshes:  # which are static, and cannot be cleared
            to.put(entities.robot(shape.topic), rr.Transform3D(scale=0.0))


def fixed_parts(frame: Frame) -> dict[str, Callable[[], Fixed | None]]:
    """What holds at all times, by entity, and how it is made: meshes of the robot's, the axes of its Imus."""
    around, found = frame.around or Around(), dict[str, Callable[[], Fixed | None]]()
    for shape in around.shapes:
        for number, mesh in enumerate(shape.meshes):
            found[f"{entities.robot(shape.topic)}/mesh_{number}"] = partial(_mesh, mesh)
    for motion in around.motions:
        found[entities.rotation(motion.topic)] = found[entities.acceleration(motion.topic)] = _axes
    return found


def log_motions(to: Writer, frame: Frame) -> None:
    """What Imus measured since the frame before, each sample at its own time."""
    for motion in (frame.around or Around()).motions:
        for path, values in (
            (entities.rotation(motion.topic), motion.rotation),
            (entities.acceleration(motion.topic), motion.acceleration),
        ):
            rows = np.isfinite(values).all(axis=1)
            if rows.any():
                to.samples(path, motion.stamp[rows], motion.received[rows], values[rows])


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
    if shape.surface is not None:
        to.put(path, _surface(shape.surface))
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


def _surface(surface: Surface) -> rr.AsComponents:
    """In colours from its least to its greatest value; single cells as points."""
    low, high = np.percentile(surface.values, (1, 99)).tolist()
    rows = bins(surface.values, low, max(high, low + 1e-6), len(turbo()))
    colors = turbo()[rows]
    if len(surface.triangles) == 0:
        return rr.Points3D(surface.vertices, colors=colors, radii=rr.Radius.ui_points(3))
    return rr.Mesh3D(
        vertex_positions=surface.vertices, triangle_indices=surface.triangles, vertex_colors=colors
    )


def _mesh(mesh: MeshFile) -> Fixed | None:
    try:
        contents = mesh.path.read_bytes()
    except OSError:
        return None
    asset = rr.Asset3D(contents=contents, media_type=_media_type(mesh.path))
    quaternion = rr.Quaternion(xyzw=geometry.quaternion(mesh.pose))
    place = rr.InstancePoses3D(translations=[mesh.pose[:3, 3]], quaternions=[quaternion], scales=[mesh.scale])
    return asset, place


def _media_type(path: Path) -> str | rr.components.MediaType | None:
    suffix = path.suffix.lower()
    return _TYPES.get(suffix) or rr.components.MediaType.guess_from_path(path.with_suffix(suffix))


def _axes() -> Fixed:
    return (rr.SeriesLines(names=list(_AXES), colors=list(_AXES.values())),)


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
