"""Decoder for clouds that point_cloud_transport compressed by draco, by the library DracoPy."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np

from bevviz.drivers.compressed_clouds import COMPRESSED
from bevviz.errors import first_line
from bevviz.messages.clouds import SCALARS, unpack_cloud
from bevviz.messages.decoders import Decoder
from bevviz.model.frame import Cloud
from bevviz.support.limits import MOST_POINTS


def decode(msg: Any) -> Cloud:
    """Decode a CompressedPointCloud2 of the format draco.

    point_cloud_transport's plugin stores one attribute for each field, in their order.

    Raises:
        ValueError: the data are damaged, or do not fit the fields of the message.
    """
    import DracoPy

    # Not bytes(msg...): if the field is a number, bytes() would allocate that many zeros.
    data = memoryview(msg.compressed_data).tobytes()
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
    return unpack_cloud(msg, points, count)


def _missing() -> str:
    """Return the library to install; empty if it is installed."""
    return "" if find_spec("DracoPy") else "which DracoPy reads: pip install 'bevviz[lidars]'"


DECODER = Decoder(types=(f"{COMPRESSED}/draco",), kind="PointCloud2", from_message=decode, missing=_missing)
