"""Livox's CustomMsg, with the definitions of both drivers."""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import numpy as np
from rosbags.typesys import get_types_from_msg

from tests.support import bags

POINT = """uint32 offset_time      # offset time relative to the base time
float32 x               # X axis, unit:m
float32 y               # Y axis, unit:m
float32 z               # Z axis, unit:m
uint8 reflectivity      # reflectivity, 0~255
uint8 tag               # livox tag
uint8 line              # laser number in lidar
"""


CUSTOM = """std_msgs/Header header
uint64 timebase           # The time of first point
uint32 point_num          # Total number of pointclouds
uint8 lidar_id            # Lidar device id number
uint8[3] rsvd             # Reserved use
CustomPoint[] points      # Pointcloud data
"""


def messages(ros1: bool, package: str, point: str = POINT) -> bags.Messages:
    found = bags.Messages(ros1)
    for name in [name for name in found.store.fielddefs if name.startswith(f"{package}/")]:
        del found.store.fielddefs[name]  # the definition of a former driver may differ
    types = get_types_from_msg(point, f"{package}/msg/CustomPoint")
    found.store.register(types | get_types_from_msg(CUSTOM, f"{package}/msg/CustomMsg"))
    return found


def scan(made: bags.Messages, package: str, stamp: int, frame: str = "livox_frame", points: int = 50) -> Any:
    """Make a scan of a floor, seen from 1.5 m. The last point is a beam that met nothing."""
    rng = np.random.default_rng(stamp % 1000)
    xyz = rng.uniform([-5, -5, -1.5], [15, 5, -1.4], (points, 3)).astype(np.float32)
    xyz[-1:] = 0
    kind = f"{package}/msg/CustomPoint"
    fields = [field.name for field in dataclasses.fields(cast(Any, made.store.types[kind]))]
    rows = [
        made.make(
            kind,
            **{
                name: value
                for name, value in {
                    "offset_time": 5000 * i,
                    **dict(zip("xyz", xyz[i].tolist(), strict=True)),
                    "reflectivity": i % 256,
                    "tag": 16 * (i % 4),
                    "line": i % 6,
                }.items()
                if name in fields
            },
        )
        for i in range(points)
    ]
    return made.make(
        f"{package}/msg/CustomMsg",
        header=made.header(stamp, frame),
        timebase=stamp,
        point_num=points,
        lidar_id=1,
        rsvd=np.zeros(3, np.uint8),
        points=rows,
    )
