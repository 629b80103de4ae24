"""Livox's own kind of cloud, CustomMsg of livox_ros_driver and livox_ros_driver2, as a PointCloud2.

The serialised message is read as an array: as objects its points, up to 500,000 a second, would be slow.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bevviz.messages.clouds import MOST_POINTS
from bevviz.messages.decoders import Bytes, Decoder, Serialization
from bevviz.messages.encode import encode_points

# Of a CustomPoint of both drivers; a bag that defines it otherwise is believed.
FIELDS = (
    ("offset_time", "uint32"),
    ("x", "float32"),
    ("y", "float32"),
    ("z", "float32"),
    ("reflectivity", "uint8"),
    ("tag", "uint8"),
    ("line", "uint8"),
)
READ = {"reflectivity": "intensity"}  # as the drivers' own PointCloud2 has it, a float32
SECOND = 1_000_000_000


def read_custom(data: bytes | memoryview, *, ros1: bool, fields: Sequence[tuple[str, str]] = FIELDS) -> Any:
    """The sensor_msgs/PointCloud2 that a serialised CustomMsg stands for.

    The stamp is that of the header; ``offset_time`` of a point is in nanoseconds after the first one. Points
    that the message announces and does not hold are announced in the result, too.

    Args:
        data: as serialised by ROS 1, or as CDR.
        ros1: which of the two.
        fields: name and type of those of a point.

    Raises:
        ValueError: no such message, or it ends before its points.
    """
    order = "<" if ros1 or data[1:2] != b"\0" else ">"
    at = 4  # behind the encoding, or the seq
    try:
        sec, nanosec, length = struct.unpack_from(f"{order}III", data, at)
        frame_id = bytes(data[at + 12 : at + 12 + length]).rstrip(b"\0").decode()
        at += 12 + length
        at += 0 if ros1 else -(at - 4) % 8
        at += 8 + 4 + 4  # timebase, point_num, lidar_id and three bytes in reserve
        (count,) = struct.unpack_from(f"{order}I", data, at)
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError(f"{len(data)} bytes are no CustomMsg") from error
    at += 4
    if count > MOST_POINTS:
        raise ValueError(f"a cloud of {count} points is not taken: {MOST_POINTS} at most")
    formats = [np.dtype(kind).newbyteorder("<" if order == "<" else ">") for _, kind in fields]
    offsets, size = list[int](), 0
    for kind in formats:  # CDR aligns each number, and each point, to its own size
        size += 0 if ros1 else -size % kind.itemsize
        offsets.append(size)
        size += kind.itemsize
    step = size if ros1 else size + -size % max(kind.itemsize for kind in formats)
    # Behind the last point nothing is padded.
    there = min(count, max(0, (len(data) - at - size) // step + 1))
    names = [name for name, _ in fields]
    point: np.dtype[np.void] = np.dtype(
        {"names": names, "formats": formats, "offsets": offsets, "itemsize": size}
    )
    given = np.ndarray((there,), point, data, at, (step,))
    return encode_points(sec * SECOND + nanosec, frame_id, _as_read(given), count)


def _as_read(given: Any) -> Any:
    """(N,) contiguous, x, y and z first."""
    names = sorted(given.dtype.names, key=lambda name: (name not in ("x", "y", "z"), name != "reflectivity"))
    layout = [
        (READ.get(name, name), "<f4" if name in READ else given.dtype[name].newbyteorder("<"))
        for name in names
    ]
    points = np.empty(len(given), np.dtype(layout))
    for name in names:
        points[READ.get(name, name)] = given[name]
    return points


def fields_of(definitions: Mapping[str, Any], msgtype: str) -> Sequence[tuple[str, str]]:
    """Name and type of the fields of a point, as rosbags has a bag's definitions; without them those known.

    Raises:
        ValueError: they are no numbers.
    """
    _, stated = definitions.get(msgtype.replace("CustomMsg", "CustomPoint"), (None, None))
    if stated is None:
        return FIELDS
    found = []
    for name, (kind, content) in stated:
        if kind.name != "BASE":
            raise ValueError(f"its points have a field {name} that is no number")
        found.append((str(name), str(content[0])))
    return found


def read_message(data: Bytes, serialization: Serialization) -> Any:
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
