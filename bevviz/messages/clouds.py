"""Point clouds of ROS messages as arrays."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz.messages.decoders import MessageError, frame_name, stamp_ns
from bevviz.model.frame import F32, U8, Cloud
from bevviz.support.limits import MOST_POINTS

MOST_FIELDS = 1024  # fields of a point; each element of a field counts
# Metres from the cloud's origin. No sensor measures so far, and coordinates on Earth are smaller (UTM: 1e7).
# Stages compute squares and higher powers, which do not fit into float32 for larger numbers.
FARTHEST = 1e8
SMALLEST = 1e-9  # metres; rounding makes numbers of this size
SAMPLE = 512  # points whose ranges are compared
# Share of them in one millimetre, from which on they are no returns. Real scans have 0.002, a simulator
# without noise 1/16: a ring of a LiDAR of 16 beams on level ground.
ALIKE = 0.15
MEASURED = 0.5  # share of the coordinates within these limits; in the wrong byte order a quarter is

_AXES = ("x", "y", "z")
# By datatype of a PointField.
SCALARS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


class LayoutError(ValueError):
    """Error for points that do not fit the fields that are stated for them."""


@dataclass(frozen=True, slots=True)
class Field:
    """Field of a point, with the attributes of a sensor_msgs/PointField."""

    name: str
    offset: int  # bytes
    datatype: int  # key of SCALARS
    count: int = 1


def decode_cloud(msg: Any, topic: str, received: int) -> Cloud:
    """Decode points and further fields of a sensor_msgs/PointCloud2, see ``make_cloud``.

    Fields may have any type, offset, padding and byte order. Organised clouds are flattened row by row. A
    field of several elements becomes one field for each element: ``name_0``, ``name_1`` ...

    Args:
        msg: the message, or the cloud that the decoder of another message type made.
        topic: topic of the message.
        received: time of receipt, nanoseconds.

    Raises:
        MessageError: x, y or z is missing, a field does not fit into its point, or the header announces more
            than ``MOST_POINTS`` points or ``MOST_FIELDS`` fields.
    """
    if isinstance(msg, Cloud):
        return replace(msg, topic=topic, received=received)
    try:
        cloud = unpack_cloud(msg, msg.data)
    except LayoutError as error:
        raise MessageError(f"{topic}: {error}") from None
    return replace(cloud, topic=topic, received=received)


def unpack_cloud(msg: Any, data: Any, count: int | None = None) -> Cloud:
    """Make a cloud of points that have the layout of a message.

    Args:
        msg: message with the fields of a sensor_msgs/PointCloud2. Its ``data`` is not used.
        data: bytes of the points.
        count: number of points, all in one row; None: as the message states.

    Raises:
        LayoutError: the points do not fit the message.
    """
    rows, columns = (int(msg.height), int(msg.width)) if count is None else (1, count)
    if rows * columns > MOST_POINTS:
        raise LayoutError(
            f"a cloud of {columns} x {rows} points is not taken: {MOST_POINTS} at most, and there are "
            f"{len(data)} bytes of data"
        )
    layout = point_layout(msg.fields, msg.point_step, ">" if msg.is_bigendian else "<")
    grid, doubt = _point_grid(np.frombuffer(data, np.uint8), layout, rows, columns, int(msg.row_step))
    if not _look_measured(grid) and _look_measured(swapped := grid.view(layout.newbyteorder())):
        grid = swapped
        flag = bool(msg.is_bigendian)
        doubt = (
            f"is_bigendian is {flag}, but only the other byte order gives coordinates of a sensor: it is read"
        )
    cloud = make_cloud(stamp_ns(msg.header.stamp), msg.header.frame_id, grid, rows * columns)
    return replace(cloud, doubt=doubt or _same_range(cloud.xyz))


def make_cloud(stamp: int, frame_id: str, points: NDArray[np.void], announced: int = 0) -> Cloud:
    """Make a cloud of structured points.

    These points are dropped and counted in ``Cloud.dropped``: points with a coordinate that is NaN, infinite
    or beyond ``FARTHEST``; points at (0, 0, 0), which drivers send for beams without a return; and points
    that are announced but missing.

    Args:
        stamp: nanoseconds.
        frame_id: frame of the points.
        points: structured array of any shape, with x, y, z and further fields of numbers.
        announced: number of points that a message states, if larger than that of the array.

    Raises:
        LayoutError: x, y or z is missing, a field is not a number that a PointField can have, or there are
            more than ``MOST_POINTS`` points.
    """
    names = points.dtype.names or ()
    if missing := [name for name in _AXES if name not in names]:
        raise LayoutError(
            f"the cloud has no field {', '.join(missing)}; its fields are {', '.join(names) or 'none'}"
        )
    if odd := [name for name in names if points.dtype[name].str[1:] not in SCALARS.values()]:
        raise LayoutError(f"the field {odd[0]} of its points is {points.dtype[odd[0]]}, not a number")
    announced = max(announced, points.size)
    if announced > MOST_POINTS:
        raise LayoutError(f"a cloud of {announced} points is not taken: {MOST_POINTS} at most")
    with np.errstate(
        over="ignore", invalid="ignore"
    ):  # float64 values beyond float32 become infinite and are dropped
        xyz = _positions(points)
        x, y, z = xyz.T
        squared = x * x + y * y + z * z
        usable = squared <= np.float32(FARTHEST**2)  # false for NaN and for overflow
    if not squared.all():
        usable &= xyz.any(axis=1)
    kept = None if usable.all() else np.flatnonzero(usable)
    fields: dict[str, NDArray[Any]] = {}
    for name in names:
        if name not in _AXES:
            values = points[name].reshape(-1)
            # A copy, because a view would be unaligned and read-only and keep the whole message in memory.
            values = values.copy() if kept is None else values.take(kept)
            fields[name] = np.asarray(values, values.dtype.newbyteorder("="))
    if kept is not None:
        xyz = xyz.take(kept, axis=0)
    return Cloud(stamp, frame_name(frame_id), xyz, fields, dropped=announced - len(xyz))


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


def point_layout(fields: Iterable[Any], step: int, order: str = "<") -> np.dtype[np.void]:
    """Return the structured dtype of a point.

    Args:
        fields: fields with the attributes of ``Field``.
        step: bytes of a point.
        order: byte order, ``<`` or ``>``.

    Raises:
        LayoutError: a field does not fit into the point, or there are more than ``MOST_FIELDS``.
    """
    if not 0 < step < 1 << 31:
        raise LayoutError(f"a point of {step} bytes cannot be")
    fields = list(fields)
    if sum(max(int(field.count), 1) for field in fields) > MOST_FIELDS:
        raise LayoutError(f"its points have more than {MOST_FIELDS} fields, each element counted")
    formats: dict[str, str] = {}
    offsets: dict[str, int] = {}
    for field in fields:
        if field.datatype not in SCALARS:
            raise LayoutError(f"field '{field.name}' has the unknown datatype {field.datatype}")
        scalar = np.dtype(order + SCALARS[field.datatype])
        count = max(int(field.count), 1)  # old drivers send 0
        if field.offset + count * scalar.itemsize > step:
            raise LayoutError(
                f"field '{field.name}' ends at byte {field.offset + count * scalar.itemsize} of a point, but "
                f"point_step is {step}"
            )
        for i in range(count):
            name = field.name if count == 1 else f"{field.name}_{i}"
            formats.setdefault(name, scalar.str)
            offsets.setdefault(name, field.offset + i * scalar.itemsize)
    return np.dtype(
        {
            "names": list(formats),
            "formats": list(formats.values()),
            "offsets": list(offsets.values()),
            "itemsize": int(step),
        }
    )


def _point_grid(
    data: U8, layout: np.dtype[np.void], rows: int, columns: int, row_step: int
) -> tuple[NDArray[np.void], str]:
    """Return a view of the points that the data hold completely, and what does not fit the data's length.

    Many drivers send a wrong ``row_step`` or ``height``: the data's length decides.
    """
    size, step = data.size, layout.itemsize
    header = f"{columns} x {rows} points of {step} bytes and a row_step of {row_step}"
    if not rows and size == columns * step:
        rows = 1
    stated, row_bytes = rows * columns, columns * step
    pitch = _row_pitch(size, rows, row_bytes, row_step)
    surplus = (size - rows * pitch) // step
    guessed = pitch not in (row_bytes, row_step)
    if pitch == row_bytes:
        rows, columns = 1, min(stated, size // step)
    else:
        rows = min(rows, max(size - row_bytes, -pitch) // pitch + 1)
    if lost := stated - rows * columns:
        outcome = f"{lost} of {stated} points are missing"
    elif surplus > 0:
        outcome = f"up to {surplus} points are not read"
    elif guessed:
        outcome = f"rows of {pitch} bytes are read"
    else:
        return np.ndarray((rows, columns), layout, data, strides=(pitch, step)), ""
    doubt = f"a cloud states {header}, which does not fit its {size} bytes of data: {outcome}"
    return np.ndarray((rows, columns), layout, data, strides=(pitch, step)), doubt


def _look_measured(grid: NDArray[np.void]) -> bool:
    """Return whether x, y and z of a sample of the points are numbers that a sensor measures.

    Most floats that are read in the wrong byte order are far too small or too large.
    """
    sample = grid[:: len(grid) // 16 + 1, :: grid.shape[1] // 64 + 1] if grid.size else grid
    values = np.array([sample[name] for name in _AXES if name in (sample.dtype.names or ())], np.float64)
    values = np.abs(values[np.isfinite(values) & (values != 0)])
    plausible = (values > SMALLEST) & (values < FARTHEST)
    return not len(values) or float(plausible.mean()) > MEASURED


def _same_range(xyz: F32) -> str:
    """Return what is odd about the ranges of points: many are one number. Empty: nothing."""
    if len(xyz) < SAMPLE:
        return ""
    sample = xyz[np.linspace(0, len(xyz) - 1, SAMPLE).astype(np.int64)].astype(np.float64)
    millimetres, counts = np.unique(np.rint(1000 * np.linalg.norm(sample, axis=1)), return_counts=True)
    share, most = counts.max() / SAMPLE, millimetres[counts.argmax()] / 1000
    if share < ALIKE:
        return ""
    return (
        f"{100 * share:.0f} % of the points of a cloud have the range {most:g} m, as a driver writes beams "
        "without a return: let it write NaN or (0, 0, 0), which are dropped"
    )


def _row_pitch(size: int, rows: int, row_bytes: int, row_step: int) -> int:
    """Return the bytes from the start of a row to that of the next, by the length of the data."""
    if rows <= 1 or row_step <= row_bytes or size == rows * row_bytes:
        return row_bytes
    if size in (rows * row_step, (rows - 1) * row_step + row_bytes):
        return row_step
    if size > rows * row_bytes and not size % rows:
        return size // rows
    # The data are cut or too long. A step that is longer than the cloud is wrong all the same.
    return row_step if row_step < rows * row_bytes else row_bytes
