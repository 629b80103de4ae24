"""Decoder for CompressedPointCloud2 messages of point_cloud_transport: zstd, zlib and draco."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from backports import zstd

from bevviz.errors import first_line
from bevviz.messages.clouds import MOST_POINTS, SCALARS
from bevviz.messages.decoders import Decoder
from bevviz.messages.encode import make

LEAST, LONGEST = 1 << 24, 1 << 30  # limits in bytes of a decompressed cloud; its message may state any size
DRACO = "which DracoPy reads: pip install 'bevviz[draco]'"
COMPRESSED = "point_cloud_interfaces/msg/CompressedPointCloud2"


def decompress(msg: Any) -> Any:
    """Decompress a CompressedPointCloud2 into a sensor_msgs/PointCloud2.

    Raises:
        ValueError: the format is not supported, or the data are damaged.
    """
    # Not bytes(msg...): if the field is a number, bytes() would allocate that many zeros.
    data = memoryview(msg.compressed_data).tobytes()
    width, height = int(msg.width), int(msg.height)
    size = height * max(int(msg.row_step), width * int(msg.point_step))
    if msg.format == "zstd":
        unpacked = np.frombuffer(_unpack(zstd.ZstdDecompressor(), data, size), np.uint8)
    elif msg.format == "zlib":
        # 32 + 15: accepts headers of zlib and of gzip.
        unpacked = np.frombuffer(_unpack(zlib.decompressobj(47), data, size), np.uint8)
    elif msg.format == "draco":
        unpacked = _from_draco(msg, data)
        width, height = len(unpacked) // max(int(msg.point_step), 1), 1
    else:
        raise ValueError(f"a cloud compressed by '{msg.format}' is not read: zstd, zlib and draco are")
    return make(
        "sensor_msgs/msg/PointCloud2",
        header=msg.header,
        height=height,
        width=width,
        fields=msg.fields,
        is_bigendian=msg.is_bigendian,
        point_step=msg.point_step,
        row_step=width * int(msg.point_step) if msg.format == "draco" else msg.row_step,
        data=unpacked,
        is_dense=msg.is_dense,
    )


def _unpack(stream: Any, data: bytes, size: int) -> bytes:
    """Decompress a cloud. ``size`` is the number of bytes that the message states, and limits the memory."""
    try:
        content: bytes = stream.decompress(data, min(max(size, LEAST), LONGEST))
    except (zlib.error, zstd.ZstdError) as error:
        raise ValueError(f"its compressed data is damaged ({first_line(error)})") from None
    if not stream.eof:
        raise ValueError("the end of its compressed data is missing, or it is too long")
    return content


def _from_draco(msg: Any, data: bytes) -> Any:
    """Decompress draco data into (N * point_step,) bytes.

    point_cloud_transport's plugin stores one attribute for each field, in their order.
    """
    try:
        import DracoPy
    except ImportError:
        raise ValueError(f"it is compressed by draco, {DRACO}") from None
    try:
        attributes = DracoPy.decode(data).attributes
    except Exception as error:  # exceptions of DracoPy, and others that its C++ extension raises
        raise ValueError(f"its draco data is damaged ({first_line(error)})") from None
    step, count = int(msg.point_step), len(attributes[0]["data"]) if attributes else 0
    if len(attributes) != len(msg.fields) or count > MOST_POINTS or not 0 < step < 1 << 16:
        raise ValueError(
            f"its draco data has {len(attributes)} attributes of {count} points, but {len(msg.fields)} fields"
        )
    points = np.zeros(count * step, np.uint8)
    for field, attribute in zip(msg.fields, attributes, strict=True):
        values = np.asarray(attribute["data"]).reshape(count, -1)
        kind = np.dtype(SCALARS.get(int(field.datatype), "u1"))
        if values.dtype == np.uint8 and values.shape[1] == kind.itemsize:  # rgb is stored as four bytes
            kind = np.dtype(np.uint8)
        end = int(field.offset) + values.shape[1] * kind.itemsize
        if end > step:
            raise ValueError(f"its field {field.name} ends at byte {end} of {step}")
        shape, steps = values.shape, (step, kind.itemsize)
        np.ndarray(shape, kind, points, int(field.offset), steps)[...] = values
    return points


DEFINITIONS = {
    COMPRESSED: "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n"
    "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] compressed_data\nbool is_dense\n"
    "string format\n"
}
DECODER = Decoder(types=(COMPRESSED,), kind="PointCloud2", from_message=decompress, definitions=DEFINITIONS)
