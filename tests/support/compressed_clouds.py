"""Clouds as point_cloud_transport's plugins compress them."""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from backports import zstd

from bevviz.drivers.compressed_clouds import COMPRESSED
from bevviz.model.frame import F32
from tests.support import bags

# Twelve points, (4 + i, i % 4 - 1.5, -1.5 + i / 16), intensity 10 i, ring i % 3, rgb 0x102030 + i, encoded by
# Google's draco 1.5.5 with the calls of draco_point_cloud_transport, an attribute a field: as they are, and
# as a k-d tree of 14 bits.
DRACO = (
    "RFJBQ08CAwAAAIAAAQtkZWR1cGxpY2F0ZQQBAAAAAAwAAAABBgAJAQAAAAkBAAEACQEAAgQJAQADBAQBAAQCAgQABQAAAAABAQAAgEAA"
    "AKBAAADAQAAA4EAAAABBAAAQQQAAIEEAADBBAABAQQAAUEEAAGBBAABwQQAAwL8AAAC/AAAAPwAAwD8AAMC/AAAAvwAAAD8AAMA/AADA"
    "vwAAAL8AAAA/AADAPwAAwL8AALi/AACwvwAAqL8AAKC/AACYvwAAkL8AAIi/AACAvwAAcL8AAGC/AABQvwAAAAAAACBBAACgQQAA8EEA"
    "ACBCAABIQgAAcEIAAIxCAACgQgAAtEIAAMhCAADcQgABAQEBA1UFA606AxAgiAAAAAACAAAAAAEBAQE4WS0DrQ5PVQEfVQFXVQEJC92c"
    "iod80j1/AAAAADsAAAA=",
    "RFJBQ08CAwABAIAAAQtkZWR1cGxpY2F0ZQQBAAAAAAwAAAABBgAJAQAAAAkBAAEACQEAAgQJAQADBAQBAAQCAgQABQMOAAAADAAAAJcH"
    "JR0AXJtHhLQAAACALtJFEHADAggAQAD///+6QAD8/wQAATv//wEAi3bR/6ADAoAAQAAQoaouGgCgC3QAATYALgAABIwuqoqADCAAAEAA"
    "IFTV6AIAXTS6AswAAAAABADx/9NFACy6dCAADiALAEAA6ADAogAAF70AAuQA0QAABFy0qnLARb/oEFADBB0AQADoUlUXIABElwQAATEV"
    "XQAAAAAAVQADAAAAQAAQCwAAAAAU3aIAATQgdAEABAAAAFAEAAAAAAAAAAQAAAAAAADBAACAQAAAMEEOAADAvwAAQEAOAADAvwAAMD8O"
    "AAAAAAAA3EIO",
)


FIELDS = (("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("rgb", 18, 7))


def messages(ros1: bool = False) -> bags.Messages:
    return bags.Messages(ros1)


def compressed(made: bags.Messages, cloud: Any, form: str, data: bytes) -> Any:
    names = ("header", "height", "width", "fields", "is_bigendian", "point_step", "row_step", "is_dense")
    values = {name: getattr(cloud, name) for name in names}
    return made.make(COMPRESSED, **values, compressed_data=np.frombuffer(data, np.uint8), format=form)


def packed(form: str, data: bytes) -> bytes:
    if form == "zstd":
        return zstd.compress(data)
    stream = zlib.compressobj(wbits=31 if form == "gzip" else 15)
    return stream.compress(data) + stream.flush()


def points(seed: int) -> F32:
    return np.random.default_rng(seed).uniform(-9, 9, (500, 4)).astype(np.float32)


def draco(data: bytes) -> Any:
    """Make the message of the twelve points."""
    made = messages()
    field = "sensor_msgs/msg/PointField"
    fields = [made.make(field, name=n, offset=at, datatype=kind, count=1) for n, at, kind in FIELDS]
    cloud = made.cloud(bags.START, np.zeros((12, 4), np.float32))
    cloud.fields, cloud.point_step, cloud.row_step = fields, 22, 12 * 22
    return compressed(made, cloud, "draco", data)
