"""Log data of the robot other than its perception: marks, diagnostics, IMUs, shapes in the world."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np
import rerun as rr

from bevviz.model import geometry
from bevviz.model.frame import (
    ComponentStatus,
    Frame,
    HeightMap,
    MeshFile,
    OccupancyGrid,
    PlacedShape,
    RobotContext,
)
from bevviz.recording import entities
from bevviz.recording.primitives import transform
from bevviz.recording.writer import Writer
from bevviz.support.colors import CONTEXT, StateColor, color_rows, turbo

DIAGNOSTIC_LANES = 40  # lanes for the robot's worst diagnostics
_WORST = ("error", "stale", "warning", "ok")
_PARTS = ("points", "strips", "solids", "axes", "grid", "surface", "fix", "picture")
_TYPES = {".dae": "model/vnd.collada+xml"}  # media types that Rerun does not guess from the file name
_AXES = {"x": StateColor.BAD.value, "y": StateColor.DOUBTFUL.value, "z": StateColor.GOOD.value}

StaticData: TypeAlias = Sequence[rr.AsComponents]
_COLOR = CONTEXT


def log_shapes(to: Writer, frame: Frame) -> None:
    """Log shapes that have a pose in the fixed frame, geographic positions and pictures."""
    for shape in (frame.around or RobotContext()).shapes:
        flat = shape.fix is not None or shape.picture is not None
        if flat or shape.world_from_shape is not None:
            _log_shape(to, shape)
        elif shape.meshes:  # meshes are static and cannot be cleared: a scale of 0 hides them
            to.put(entities.ROBOT.path(shape.topic), rr.Transform3D(scale=0.0))


def static_data_makers(frame: Frame) -> dict[str, Callable[[], StaticData | None]]:
    """Return functions that make the static data, by entity: the robot's meshes, and the axes of its IMUs."""
    surroundings, makers = frame.around or RobotContext(), dict[str, Callable[[], StaticData | None]]()
    for shape in surroundings.shapes:
        for number, mesh in enumerate(shape.meshes):
            makers[entities.MESH.path(shape.topic, f"mesh_{number}")] = partial(_mesh, mesh)
    for motion in surroundings.motions:
        makers[entities.ROTATION.path(motion.topic)] = makers[entities.ACCELERATION.path(motion.topic)] = (
            _axes
        )
    return makers


def log_imu_samples(to: Writer, frame: Frame) -> None:
    """Log IMU samples since the previous frame, each at its own time."""
    for motion in (frame.around or RobotContext()).motions:
        for path, values in (
            (entities.ROTATION.path(motion.topic), motion.rotation),
            (entities.ACCELERATION.path(motion.topic), motion.acceleration),
        ):
            rows = np.isfinite(values).all(axis=1)
            if rows.any():
                to.samples(path, motion.stamp[rows], motion.received[rows], values[rows])


class DiagnosticsLog:
    """Log lines of marks and diagnostics. It remembers the diagnostics, so that only changes make a line."""

    def __init__(self) -> None:
        self._last_texts: dict[str, str] = {}  # name of the status -> its text

    def lines(self, frame: Frame) -> list[tuple[str, str]]:
        """Return log lines (level and text) of marks and of changed diagnostics."""
        return [*mark_lines(frame), *self._news((frame.around or RobotContext()).statuses)]

    def _news(self, statuses: Sequence[ComponentStatus]) -> list[tuple[str, str]]:
        """Return log lines of statuses that changed. A first status makes a line only if it is not ok."""
        lines = []
        for status in statuses:
            text = f"{status.name}: {status.level}{f', {status.text}' if status.text else ''}"
            before = self._last_texts.get(status.name)
            if text != before and not (before is None and status.level == "ok"):
                level = {"ok": "INFO", "error": "ERROR"}.get(status.level, "WARN")
                lines.append((level, f"diagnostics: {text}"))
            self._last_texts[status.name] = text
        return lines


def diagnostic_states(frame: Frame) -> dict[str, str]:
    """Return state lane -> level of the robot's worst diagnostics."""
    statuses = frame.around.statuses if frame.around else ()
    shown = sorted(statuses, key=lambda status: _WORST.index(status.level))[:DIAGNOSTIC_LANES]
    return {entities.DIAGNOSTIC.path(status.name): status.level for status in shown}


def mark_lines(frame: Frame) -> list[tuple[str, str]]:
    """Return users' notes at this frame as log lines."""
    return [("INFO", f"mark: {text}") for text in (frame.around.marks if frame.around else ())]


def _log_shape(to: Writer, shape: PlacedShape) -> None:
    path = entities.ROBOT.path(shape.topic)
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
        position, rotation = shape.axes[:3, 3], shape.axes[:3, :3]
        to.put(path, rr.Arrows3D(origins=[position], vectors=[rotation[:, 0]], colors=color))
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


def _surface(surface: HeightMap) -> rr.AsComponents:
    """Colour a surface from its lowest to its highest value. A surface without triangles becomes points."""
    low, high = np.percentile(surface.values, (1, 99)).tolist()
    rows = color_rows(surface.values, low, max(high, low + 1e-6), len(turbo()))
    colors = turbo()[rows]
    if len(surface.triangles) == 0:
        return rr.Points3D(surface.vertices, colors=colors, radii=rr.Radius.ui_points(3))
    return rr.Mesh3D(
        vertex_positions=surface.vertices, triangle_indices=surface.triangles, vertex_colors=colors
    )


def _mesh(mesh: MeshFile) -> StaticData | None:
    try:
        contents = mesh.path.read_bytes()
    except OSError:
        return None
    asset = rr.Asset3D(contents=contents, media_type=_media_type(mesh.path))
    quaternion = rr.Quaternion(xyzw=geometry.quaternion(mesh.pose))
    pose = rr.InstancePoses3D(translations=[mesh.pose[:3, 3]], quaternions=[quaternion], scales=[mesh.scale])
    return asset, pose


def _media_type(path: Path) -> str | rr.components.MediaType | None:
    suffix = path.suffix.lower()
    return _TYPES.get(suffix) or rr.components.MediaType.guess_from_path(path.with_suffix(suffix))


def _axes() -> StaticData:
    return (rr.SeriesLines(names=list(_AXES), colors=list(_AXES.values())),)


def _grid(grid: OccupancyGrid) -> rr.GridMap:
    rows, columns = grid.cells.shape
    return rr.GridMap(
        data=grid.cells[::-1].tobytes(),
        format=rr.components.ImageFormat(width=columns, height=rows, color_model="L", channel_datatype="U8"),
        cell_size=grid.resolution,
        translation=grid.pose[:3, 3],
        quaternion=rr.Quaternion(xyzw=geometry.quaternion(grid.pose)),
        colormap=rr.components.Colormap.RvizMap,
        opacity=0.6,  # lower layers stay visible
    )
