"""Messages of a robot around its perception: marks, diagnostics, and shapes in the world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from bevviz.messages.clouds import decode_cloud, decode_laser_scan
from bevviz.messages.decoders import MessageError, stamp_ns, text_of
from bevviz.messages.images import decode_image
from bevviz.messages.poses import pose_of, vector_of
from bevviz.messages.robot_description import parse_links
from bevviz.model import geometry
from bevviz.model.frame import (
    F32,
    F64,
    U8,
    ComponentStatus,
    HeightMap,
    OccupancyGrid,
    PlacedShape,
    SolidShapes,
)

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
        surface = decode_grid_map(msg, pose_of(msg.info.pose), topic)
        return [] if surface is None else [PlacedShape(*about, surface=surface)]
    if short == "LaserScan":
        return [PlacedShape(*about, points=decode_laser_scan(msg, topic, 0).xyz)]
    if short == "Path":
        positions = np.array([[*vector_of(p.pose.position)] for p in msg.poses], np.float32).reshape(-1, 3)
        return [PlacedShape(*about, strips=(positions,))] if len(positions) else []
    if short == "PoseStamped":
        return [PlacedShape(*about, axes=pose_of(msg.pose))]
    if short == "NavSatFix":
        has_fix = np.isfinite([msg.latitude, msg.longitude]).all() and msg.status.status >= 0
        return [PlacedShape(*about, fix=(float(msg.latitude), float(msg.longitude)))] if has_fix else []
    return [PlacedShape(*about, grid=_grid(msg, topic))]


def _grid(msg: Any, topic: str) -> OccupancyGrid:
    about, cells = msg.info, np.asarray(msg.data, np.int8)
    if len(cells) != about.width * about.height:
        raise MessageError(f"{topic}: {len(cells)} cells in a map of {about.width} x {about.height}")
    return OccupancyGrid(
        cells.reshape(about.height, about.width), float(about.resolution), pose_of(about.origin)
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
    pose, color = pose_of(marker.pose), _color(marker.color)
    about: dict[str, Any] = {"topic": name, "frame_id": frame.lstrip("/"), "stamp": stamp, "color": color}
    scale = np.array([*vector_of(marker.scale)], np.float32)
    points = np.array([[*vector_of(point)] for point in marker.points], np.float32).reshape(-1, 3)
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


# --- grid maps -------------------------------------------------------------------------------

HEIGHT = "elevation"  # name of the layer with heights
MOST_CELLS = 250_000  # cells that are shown; larger maps are reduced to every n-th row and column


def decode_grid_map(msg: Any, pose: F64, topic: str) -> HeightMap | None:
    """Decode a layer of a map: ``elevation`` as heights, or the first layer as colours of a plane.

    Rows of a layer run against x and columns against y, from the corner where both are greatest. The map is a
    ring buffer in both directions, because it moves with the robot (https://github.com/ANYbotics/grid_map).

    Args:
        msg: a grid_map_msgs/GridMap.
        pose: (4, 4) frame of the map from its centre.
        topic: topic of the message, for errors.

    Returns:
        The surface; None if no cell is known.

    Raises:
        MessageError: the message contradicts itself.
    """
    if not msg.layers or len(msg.layers) != len(msg.data):
        raise MessageError(f"{topic}: {len(msg.layers)} names of {len(msg.data)} layers")
    name = HEIGHT if HEIGHT in msg.layers else next(iter([*msg.basic_layers, *msg.layers]))
    if name not in msg.layers:
        raise MessageError(f"{topic}: its basic layer '{name}' is not among its layers")
    step = float(msg.info.resolution)
    if not (np.isfinite(step) and step > 0):
        raise MessageError(f"{topic}: a resolution of {step} m")
    values = _layer(msg.data[list(msg.layers).index(name)], f"{topic}: layer '{name}'")
    values = np.roll(values, (-msg.outer_start_index, -msg.inner_start_index), axis=(0, 1))
    rows, columns = values.shape
    every = int(np.ceil(np.sqrt(values.size / MOST_CELLS))) if values.size > MOST_CELLS else 1
    x = (rows / 2 - 0.5 - np.arange(0, rows, every)) * step
    y = (columns / 2 - 0.5 - np.arange(0, columns, every)) * step
    return _surface(values[::every, ::every], x, y, pose, flat=name != HEIGHT)


def _layer(array: Any, what: str) -> F32:
    """Return the (rows, columns) of a layer. Eigen stores them by columns unless the layer says otherwise."""
    values, dims = np.asarray(array.data, np.float32), array.layout.dim
    if len(dims) != 2 or dims[0].size * dims[1].size != len(values) - array.layout.data_offset:
        sizes = " x ".join(str(dim.size) for dim in dims)
        raise MessageError(f"{what}: {len(values)} values in {sizes or 'no'} cells")
    cells = values[array.layout.data_offset :].reshape(dims[0].size, dims[1].size)
    return cells if dims[0].label == "row_index" else cells.T


def _surface(values: F32, x: F64, y: F64, pose: F64, *, flat: bool) -> HeightMap | None:
    known = np.isfinite(values)
    if not known.any():
        return None
    number = np.full(values.shape, -1, np.int64)
    number[known] = np.arange(known.sum())
    grid_x, grid_y = np.meshgrid(x, y, indexing="ij")
    heights = np.zeros(int(known.sum())) if flat else values[known]
    local = np.column_stack([grid_x[known], grid_y[known], heights])
    a, b, c, d = (
        part.ravel() for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:])
    )
    both = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    triangles = both[(both >= 0).all(axis=1)].astype(np.uint32)
    vertices = geometry.apply(pose, local.astype(np.float32))
    return HeightMap(vertices, triangles, values[known])
