"""Decoder for Livox's CustomMsg of livox_ros_driver and livox_ros_driver2 into a cloud.

It reads the serialised message as an array. Deserialising up to 500,000 points a second as objects is slow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bevviz.extras.lidars.scan_messages import read_list_message
from bevviz.messages.clouds import make_cloud
from bevviz.messages.decoders import Bytes, Decoder, Serialization
from bevviz.model.frame import Cloud
from bevviz.support.limits import MOST_POINTS

# Fields of a CustomPoint of both drivers. A definition in the bag takes precedence.
FIELDS = (
    ("offset_time", "uint32"),
    ("x", "float32"),
    ("y", "float32"),
    ("z", "float32"),
    ("reflectivity", "uint8"),
    ("tag", "uint8"),
    ("line", "uint8"),
)
# Name of the field in the drivers' own PointCloud2, where it is a float32.
READ = {"reflectivity": "intensity"}


def read_custom(data: Bytes, *, ros1: bool, fields: Sequence[tuple[str, str]] = FIELDS) -> Cloud:
    """Decode a serialised CustomMsg.

    The stamp is that of the header; ``offset_time`` of a point is in nanoseconds after the first point.
    Points that the message announces but does not hold count as dropped.

    Args:
        data: message as serialised by ROS 1, or as CDR.
        ros1: whether ROS 1 serialised the message.
        fields: name and type of each field of a point.

    Raises:
        ValueError: the data are no CustomMsg, or end before its points.
    """
    # Skipped are timebase, point_num, and lidar_id with three reserved bytes.
    message = read_list_message(data, ros1=ros1, alignment=8, skipped=8 + 4 + 4)
    count, at = message.count, message.at
    if count > MOST_POINTS:
        raise ValueError(f"a cloud of {count} points is not taken: {MOST_POINTS} at most")
    formats = [np.dtype(kind).newbyteorder(message.order) for _, kind in fields]
    offsets, size = list[int](), 0
    for kind in formats:  # CDR aligns each number to its size, and each point to that of its largest number.
        size += 0 if ros1 else -size % kind.itemsize
        offsets.append(size)
        size += kind.itemsize
    step = size if ros1 else size + -size % max(kind.itemsize for kind in formats)
    # The last point has no padding behind it.
    complete = min(count, max(0, (len(data) - at - size) // step + 1))
    names = [name for name, _ in fields]
    point: np.dtype[np.void] = np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": size}
    )
    rows = np.ndarray((complete,), point, data, at, (step,))
    return make_cloud(message.stamp, message.frame_id, _to_points(rows), count)


def _to_points(rows: Any) -> Any:
    """Return the points as a contiguous (N,) array with x, y and z first and the names of ``READ``."""
    names = sorted(rows.dtype.names, key=lambda name: (name not in ("x", "y", "z"), name != "reflectivity"))
    layout = [
        (READ.get(name, name), "<f4" if name in READ else rows.dtype[name].newbyteorder("<"))
        for name in names
    ]
    points = np.empty(len(rows), np.dtype(layout))
    for name in names:
        points[READ.get(name, name)] = rows[name]
    return points


def fields_of(definitions: Mapping[str, Any], msgtype: str) -> Sequence[tuple[str, str]]:
    """Return name and type of each field of a point, by the bag's definitions or else by ``FIELDS``.

    Raises:
        ValueError: a field is not a number.
    """
    _, stated = definitions.get(msgtype.replace("CustomMsg", "CustomPoint"), (None, None))
    if stated is None:
        return FIELDS
    point_fields = []
    for name, (kind, content) in stated:
        if kind.name != "BASE":
            raise ValueError(f"its points have a field {name} that is no number")
        point_fields.append((str(name), str(content[0])))
    return point_fields


def read_message(data: Bytes, serialization: Serialization) -> Cloud:
    """Decode a CustomMsg, by the definition of the bag if there is one."""
    fields = fields_of(serialization.definitions, serialization.type)
    return read_custom(data, ros1=serialization.ros1, fields=fields)


_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
_MESSAGE = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "CustomPoint[] points\n"
)
_PACKAGES = ("livox_ros_driver", "livox_ros_driver2")
DEFINITIONS = {
    f"{package}/msg/{name}": text
    for package in _PACKAGES
    for name, text in (("CustomPoint", _POINT), ("CustomMsg", _MESSAGE))
}
DECODER = Decoder(
    types=tuple(f"{package}/msg/CustomMsg" for package in _PACKAGES),
    kind="PointCloud2",
    from_bytes=read_message,
    definitions=DEFINITIONS,
)
