"""Point clouds of ROS messages as arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz.messages.decoding import MessageError, frame_name, stamp_ns
from bevviz.model.frame import F32, Cloud

MOST_POINTS = 100_000_000  # of a cloud
MOST_FIELDS = 1024  # of a point; each element of a field counts
# Metres from the cloud's origin. No sensor measures so far, and coordinates on Earth are smaller (UTM: 1e7).
# Stages compute squares and higher powers, which do not fit into float32 for larger numbers.
FARTHEST = 1e8

_AXES = ("x", "y", "z")
SCALARS = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    8: "f8",
}  # by the datatype of a PointField


def decode_cloud(msg: Any, topic: str, received: int) -> Cloud:
    """Points and extra fields of a sensor_msgs/PointCloud2.

    Any field types, offsets, padding and byte order; organised clouds are flattened row by row. Points
    with a coordinate that is NaN or infinite are dropped, and so are those beyond ``FARTHEST``, those at
    (0, 0, 0), by which drivers mean a beam without a return, and those that the header announces but cut
    data no longer holds; all are counted in ``Cloud.dropped``. A field of several elements becomes one
    field for each: ``name_0``, ``name_1`` ...

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
    with np.errstate(over="ignore", invalid="ignore"):  # a float64 beyond float32 is infinite, and dropped
        xyz = _positions(grid)
        x, y, z = xyz.T
        squared = x * x + y * y + z * z
        usable = squared <= np.float32(FARTHEST**2)  # false for NaN and for what overflows
    if not squared.all():
        usable &= xyz.any(axis=1)
    kept = None if usable.all() else np.flatnonzero(usable)
    fields: dict[str, NDArray[Any]] = {}
    for name in layout.fields or ():
        if name not in _AXES:
            values = grid[name].reshape(-1)
            # Copied: a view would be unaligned, read-only, and keep the whole message in memory.
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


def _positions(grid: NDArray[np.void]) -> F32:
    """(N, 3) coordinates of the points, a copy."""
    layout = grid.dtype
    assert layout.fields is not None
    formats, offsets = zip(*(layout.fields[name][:2] for name in _AXES), strict=True)
    if set(formats) == {np.dtype(np.float32)} and np.diff(offsets).tolist() == [4, 4]:
        # Side by side, as most drivers have them, they are copied in one piece.
        together = np.dtype(
            {"names": ["xyz"], "formats": ["V12"], "offsets": offsets[:1], "itemsize": layout.itemsize}
        )
        return grid.view(together)["xyz"].copy().view(np.float32).reshape(-1, 3)
    xyz = np.empty((*grid.shape, 3), np.float32)
    for axis, name in enumerate(_AXES):
        xyz[..., axis] = grid[name]
    return xyz.reshape(-1, 3)


def _point_layout(msg: Any, topic: str) -> np.dtype[np.void]:
    """The structured dtype of one point; ``itemsize`` is point_step."""
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
        count = max(int(field.count), 1)  # old drivers leave it at 0
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
    """(rows, columns) view of the points that are whole in the data."""
    data = np.frombuffer(msg.data, np.uint8)
    rows, columns, step = int(msg.height), int(msg.width), layout.itemsize
    row_bytes = columns * step
    row_step = max(int(msg.row_step), row_bytes)  # some drivers leave it at 0
    if row_step == row_bytes or rows == 1:
        rows, columns = 1, min(rows * columns, data.size // step)
    else:
        rows = min(rows, max(data.size - row_bytes, -row_step) // row_step + 1)
    return np.ndarray((rows, columns), layout, data, strides=(row_step, step))
