"""Point clouds of ROS messages as arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz.messages.decoders import MessageError, frame_name, stamp_ns
from bevviz.model.frame import F32, Cloud

MOST_POINTS = 100_000_000  # largest cloud
MOST_FIELDS = 1024  # fields of a point; each element of a field counts
# Metres from the cloud's origin. No sensor measures so far, and coordinates on Earth are smaller (UTM: 1e7).
# Stages compute squares and higher powers, which do not fit into float32 for larger numbers.
FARTHEST = 1e8

_AXES = ("x", "y", "z")
# By datatype of a PointField.
SCALARS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def decode_cloud(msg: Any, topic: str, received: int) -> Cloud:
    """Decode points and further fields of a sensor_msgs/PointCloud2.

    Fields may have any type, offset, padding and byte order. Organised clouds are flattened row by row. A
    field of several elements becomes one field for each element: ``name_0``, ``name_1`` ...

    These points are dropped and counted in ``Cloud.dropped``: points with a coordinate that is NaN, infinite
    or beyond ``FARTHEST``; points at (0, 0, 0), which drivers send for beams without a return; and points
    that the header announces but the data do not hold.

    Raises:
        MessageError: x, y or z is missing, a field does not fit into its point, or the header announces more
            than ``MOST_POINTS`` points or ``MOST_FIELDS`` fields.
    """
    if (announced := int(msg.height) * int(msg.width)) > MOST_POINTS:
        raise MessageError(
            f"{topic}: a cloud of {msg.width} x {msg.height} points is not taken: "
            f"{MOST_POINTS} at most, and there are {len(msg.data)} bytes of data"
        )
    layout = _point_layout(msg, topic)
    grid = _point_grid(msg, layout)
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # float64 values beyond float32 become infinite and are dropped
        xyz = _positions(grid)
        x, y, z = xyz.T
        squared = x * x + y * y + z * z
        usable = squared <= np.float32(FARTHEST**2)  # false for NaN and for overflow
    if not squared.all():
        usable &= xyz.any(axis=1)
    kept = None if usable.all() else np.flatnonzero(usable)
    fields: dict[str, NDArray[Any]] = {}
    for name in layout.fields or ():
        if name not in _AXES:
            values = grid[name].reshape(-1)
            # A copy, because a view would be unaligned and read-only and keep the whole message in memory.
            values = values.copy() if kept is None else values.take(kept)
            fields[name] = np.asarray(values, values.dtype.newbyteorder("="))
    if kept is not None:
        xyz = xyz.take(kept, axis=0)
    return Cloud(
        stamp=stamp_ns(msg.header.stamp),
        frame_id=frame_name(msg.header.frame_id),
        xyz=xyz,
        fields=fields,
        topic=topic,
        received=received,
        dropped=announced - len(xyz),
    )


def decode_laser_scan(msg: Any, topic: str, received: int) -> Cloud:
    """Decode the points of a sensor_msgs/LaserScan, all in the plane z = 0.

    Ranges that are not within the limits of the message are dropped. ``time`` is in seconds after the stamp.

    Raises:
        MessageError: the message has more than ``MOST_POINTS`` ranges.
    """
    ranges = np.asarray(msg.ranges, np.float32)
    if len(ranges) > MOST_POINTS:
        raise MessageError(f"{topic}: a scan of {len(ranges)} ranges is not taken: {MOST_POINTS} at most")
    kept = np.flatnonzero((ranges >= msg.range_min) & (ranges <= msg.range_max) & (ranges < FARTHEST))
    angles = msg.angle_min + msg.angle_increment * kept
    xyz = np.zeros((len(kept), 3), np.float32)
    xyz[:, 0], xyz[:, 1] = ranges[kept] * np.cos(angles), ranges[kept] * np.sin(angles)
    fields: dict[str, NDArray[Any]] = {}
    intensities = np.asarray(msg.intensities, np.float32)
    if len(intensities) == len(ranges):
        fields["intensity"] = intensities[kept]
    if msg.time_increment:
        fields["time"] = (msg.time_increment * kept).astype(np.float32)
    return Cloud(
        stamp=stamp_ns(msg.header.stamp),
        frame_id=frame_name(msg.header.frame_id),
        xyz=xyz,
        fields=fields,
        topic=topic,
        received=received,
        dropped=len(ranges) - len(kept),
    )


def _positions(grid: NDArray[np.void]) -> F32:
    """Return a copy of the (N, 3) coordinates of the points."""
    layout = grid.dtype
    assert layout.fields is not None
    formats, offsets = zip(*(layout.fields[name][:2] for name in _AXES), strict=True)
    if set(formats) == {np.dtype(np.float32)} and np.diff(offsets).tolist() == [4, 4]:
        # Most drivers store x, y and z side by side: copy them in one piece.
        together = np.dtype(
            {"names": ["xyz"], "formats": ["V12"], "offsets": offsets[:1], "itemsize": layout.itemsize}
        )
        return grid.view(together)["xyz"].copy().view(np.float32).reshape(-1, 3)
    xyz = np.empty((*grid.shape, 3), np.float32)
    for axis, name in enumerate(_AXES):
        xyz[..., axis] = grid[name]
    return xyz.reshape(-1, 3)


def _point_layout(msg: Any, topic: str) -> np.dtype[np.void]:
    """Return the structured dtype of a point. Its ``itemsize`` is point_step."""
    if not 0 < msg.point_step < 1 << 31:
        raise MessageError(f"{topic}: a point of {msg.point_step} bytes cannot be")
    if sum(max(int(field.count), 1) for field in msg.fields) > MOST_FIELDS:
        raise MessageError(f"{topic}: its points have more than {MOST_FIELDS} fields, each element counted")
    order = ">" if msg.is_bigendian else "<"
    formats: dict[str, str] = {}
    offsets: dict[str, int] = {}
    for field in msg.fields:
        if field.datatype not in SCALARS:
            raise MessageError(f"{topic}: field '{field.name}' has the unknown datatype {field.datatype}")
        scalar = np.dtype(order + SCALARS[field.datatype])
        count = max(int(field.count), 1)  # old drivers send 0
        if field.offset + count * scalar.itemsize > msg.point_step:
            raise MessageError(
                f"{topic}: field '{field.name}' ends at byte {field.offset + count * scalar.itemsize} "
                f"of a point, but point_step is {msg.point_step}"
            )
        for i in range(count):
            name = field.name if count == 1 else f"{field.name}_{i}"
            formats.setdefault(name, scalar.str)
            offsets.setdefault(name, field.offset + i * scalar.itemsize)
    if missing := [name for name in _AXES if name not in formats]:
        raise MessageError(
            f"{topic}: the cloud has no field {', '.join(missing)}; "
            f"its fields are {', '.join(formats) or 'none'}"
        )
    return np.dtype(
        {
            "names": list(formats),
            "formats": list(formats.values()),
            "offsets": list(offsets.values()),
            "itemsize": int(msg.point_step),
        }
    )


def _point_grid(msg: Any, layout: np.dtype[np.void]) -> NDArray[np.void]:
    """Return a (rows, columns) view of the points that the data hold completely."""
    data = np.frombuffer(msg.data, np.uint8)
    rows, columns, step = int(msg.height), int(msg.width), layout.itemsize
    row_bytes = columns * step
    row_step = max(int(msg.row_step), row_bytes)  # some drivers send 0
    if row_step == row_bytes or rows == 1:
        rows, columns = 1, min(rows * columns, data.size // step)
    else:
        rows = min(rows, max(data.size - row_bytes, -row_step) // row_step + 1)
    return np.ndarray((rows, columns), layout, data, strides=(row_step, step))
