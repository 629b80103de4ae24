"""Decoder for CompressedPointCloud2 messages of point_cloud_transport: zstd, zlib, and formats of extras."""

from __future__ import annotations

import zlib
from typing import Any

from backports import zstd

from bevviz.errors import first_line
from bevviz.messages.clouds import unpack_cloud
from bevviz.messages.decoders import Decoder, decoders
from bevviz.model.frame import Cloud
from bevviz.support.limits import MAX_MESSAGE, MIN_CLOUD

COMPRESSED = "point_cloud_interfaces/msg/CompressedPointCloud2"


def decompress(msg: Any) -> Cloud:
    """Decode a CompressedPointCloud2.

    Raises:
        ValueError: the format is not supported, or the data are damaged.
    """
    form = str(msg.format)
    if decoder := decoders().get(f"{COMPRESSED}/{form}"):
        if why := decoder.missing():
            raise ValueError(f"it is compressed by {form}, {why}")
        assert decoder.from_message is not None
        cloud: Cloud = decoder.from_message(msg)
        return cloud
    # Not bytes(msg...): if the field is a number, bytes() would allocate that many zeros.
    data = memoryview(msg.compressed_data).tobytes()
    points, rows = int(msg.height) * int(msg.width) * int(msg.point_step), int(msg.height) * int(msg.row_step)
    size = rows if points < rows <= MAX_MESSAGE else points  # The row_step may be that of the whole cloud.
    if form == "zstd":
        return unpack_cloud(msg, _unpack(zstd.ZstdDecompressor(), data, size))
    if form == "zlib":
        # 32 + 15: accepts headers of zlib and of gzip.
        return unpack_cloud(msg, _unpack(zlib.decompressobj(47), data, size))
    extras = [name.rpartition("/")[2] for name in decoders() if name.startswith(f"{COMPRESSED}/")]
    *most, last = "zstd", "zlib", *extras
    raise ValueError(f"a cloud compressed by '{form}' is not read: {', '.join(most)} and {last} are")


def _unpack(stream: Any, data: bytes, size: int) -> bytes:
    """Decompress a cloud. ``size`` is the number of bytes that the message states, and limits the memory."""
    if size > MAX_MESSAGE:
        raise ValueError(f"it states {size:,} bytes after unpacking: {MAX_MESSAGE:,} at most are taken")
    try:
        content: bytes = stream.decompress(data, max(size, MIN_CLOUD))
    except (zlib.error, zstd.ZstdError) as error:
        raise ValueError(f"its compressed data is damaged ({first_line(error)})") from None
    if not stream.eof:
        raise ValueError("the end of its compressed data is missing, or it is too long")
    return content


DEFINITIONS = {
    COMPRESSED: "std_msgs/Header header\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n"
    "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] compressed_data\nbool is_dense\n"
    "string format\n"
}
DECODER = Decoder(types=(COMPRESSED,), kind="PointCloud2", from_message=decompress, definitions=DEFINITIONS)
