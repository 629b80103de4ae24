"""Messages of a robot around its perception: marks, diagnostics, and shapes in the world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from bevviz.messages.clouds import decode_cloud
from bevviz.messages.decoding import MessageError, stamp_ns, text_of
from bevviz.messages.grid_map import decode_grid_map
from bevviz.messages.images import decode_image
from bevviz.messages.robot_description import parse_links
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, U8, ComponentStatus, OccupancyGrid, PlacedShape, SolidShapes

LEVELS: tuple[Literal["ok", "warning", "error", "stale"], ...] = ("ok", "warning", "error", "stale")
TYPES = frozenset(
    {
        "std_msgs/msg/String",
        "diagnostic_msgs/msg/DiagnosticArray",
        "sensor_msgs/msg/LaserScan",
        "sensor_msgs/msg/NavSatFix",
        "nav_msgs/msg/Path",
        "nav_msgs/msg/OccupancyGrid",
        "grid_map_msgs/msg/GridMap",
        "geometry_msgs/msg/PoseStamped",
        "visualization_msgs/msg/Marker",
        "visualization_msgs/msg/MarkerArray",
    }
)


def decode_mark(msg: Any) -> str:
    """Return the text of a std_msgs/String."""
    return text_of(msg.data)


def decode_statuses(msg: Any) -> list[ComponentStatus]:
    """Return the statuses of a diagnostic_msgs/DiagnosticArray."""
    statuses = []
    for status in msg.status:
        number = int(status.level)
        level = LEVELS[number] if 0 <= number < len(LEVELS) else "error"
        statuses.append(ComponentStatus(text_of(status.name), level, text_of(status.message)))
    return statuses


def decode_shapes(msg: Any, short: str, topic: str) -> list[PlacedShape]:
    """Return the shapes of a message of any type in ``SHAPES``. A stamp is 0 if the message has none.

    Raises:
        MessageError: the message contradicts itself.
    """
    if short == "MarkerArray":
        return _markers(msg.markers, topic)
    if short == "Marker":
        return _markers([msg], topic)
    if short == "String":
        return list(parse_links(msg.data, topic))
    if short == "PointCloud2":
        cloud = decode_cloud(msg, topic, 0)
        return [PlacedShape(topic, cloud.frame_id.lstrip("/"), cloud.stamp, points=cloud.xyz)]
    if short == "Image":
        image = decode_image(msg, topic, 0)
        return [PlacedShape(topic, image.frame_id.lstrip("/"), image.stamp, picture=image.bgr)]
    # In ROS 1 the header is within the info.
    header = msg.info.header if short == "GridMap" and not hasattr(msg, "header") else msg.header
    about = topic, header.frame_id.lstrip("/"), stamp_ns(header.stamp)
    if short == "GridMap":
        surface = decode_grid_map(msg, _pose(msg.info.pose), topic)
        return [] if surface is None else [PlacedShape(*about, surface=surface)]
    if short == "LaserScan":
        ranges = np.asarray(msg.ranges, np.float32)
        angles = msg.angle_min + msg.angle_increment * np.arange(len(ranges))
        within = (ranges >= msg.range_min) & (ranges <= msg.range_max)
        directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(len(ranges))], axis=1)
        points = directions[within] * ranges[within, None]
        return [PlacedShape(*about, points=points.astype(np.float32))]
    if short == "Path":
        positions = np.array([[*_xyz(p.pose.position)] for p in msg.poses], np.float32).reshape(-1, 3)
        return [PlacedShape(*about, strips=(positions,))] if len(positions) else []
    if short == "PoseStamped":
        return [PlacedShape(*about, axes=_pose(msg.pose))]
    if short == "NavSatFix":
        has_fix = np.isfinite([msg.latitude, msg.longitude]).all() and msg.status.status >= 0
        return [PlacedShape(*about, fix=(float(msg.latitude), float(msg.longitude)))] if has_fix else []
    return [PlacedShape(*about, grid=_grid(msg, topic))]


def _grid(msg: Any, topic: str) -> OccupancyGrid:
    about, cells = msg.info, np.asarray(msg.data, np.int8)
    if len(cells) != about.width * about.height:
        raise MessageError(f"{topic}: {len(cells)} cells in a map of {about.width} x {about.height}")
    return OccupancyGrid(
        cells.reshape(about.height, about.width), float(about.resolution), _pose(about.origin)
    )


# --- markers -----------------------------------------------------------------------------------

_CUBE, _SPHERE, _CYLINDER, _STRIP, _LINES, _CUBES, _SPHERES, _POINTS, _TEXT = 1, 2, 3, 4, 5, 6, 7, 8, 9


def _markers(markers: Sequence[Any], topic: str) -> list[PlacedShape]:
    """Return a shape for each marker with the action ADD. A deleted marker disappears with the next array."""
    shapes = []
    for marker in markers:
        if marker.action == 0:
            stamp = stamp_ns(marker.header.stamp)
            shape = _marker(marker, f"{topic}/{marker.ns}/{marker.id}", marker.header.frame_id, stamp)
            shapes += [] if shape is None else [shape]
    return shapes


def _marker(marker: Any, name: str, frame: str, stamp: int) -> PlacedShape | None:
    pose, color = _pose(marker.pose), _color(marker.color)
    about: dict[str, Any] = {"topic": name, "frame_id": frame.lstrip("/"), "stamp": stamp, "color": color}
    scale = np.array([*_xyz(marker.scale)], np.float32)
    points = np.array([[*_xyz(point)] for point in marker.points], np.float32).reshape(-1, 3)
    points = geometry.apply(pose, points)
    if marker.type in (_CUBE, _SPHERE, _CYLINDER, _TEXT):
        half: F32 = scale[None] / np.float32(np.inf if marker.type == _TEXT else 2)
        turn: F32 = geometry.quaternion(pose)[None].astype(np.float32)
        solid = SolidShapes(pose[None, :3, 3].astype(np.float32), half, turn, round=marker.type == _SPHERE)
        return PlacedShape(**about, solids=solid, text=marker.text)
    if marker.type in (_CUBES, _SPHERES):
        turn = np.tile(geometry.quaternion(pose).astype(np.float32), (len(points), 1))
        half = np.tile(scale / np.float32(2), (len(points), 1))
        return PlacedShape(**about, solids=SolidShapes(points, half, turn, round=marker.type == _SPHERES))
    if marker.type == _STRIP:
        return PlacedShape(**about, strips=(points,))
    if marker.type == _LINES:
        return PlacedShape(**about, strips=tuple(points[: len(points) // 2 * 2].reshape(-1, 2, 3)))
    if marker.type == _POINTS:
        return PlacedShape(**about, points=points)
    if marker.type == 0 and len(points) == 2:
        return PlacedShape(**about, strips=(points,))
    return None


def _color(color: Any) -> U8:
    parts: U8 = np.round(255 * np.clip([color.r, color.g, color.b, color.a], 0, 1)).astype(np.uint8)
    return parts


def _xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _pose(pose: Any) -> F64:
    turn = pose.orientation
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    if not np.isfinite(quaternion).all() or not quaternion.any():
        quaternion = np.array([0.0, 0.0, 0.0, 1.0])  # RViz does the same with an orientation that is not set
    return geometry.transform(np.array(_xyz(pose.position)), quaternion)
