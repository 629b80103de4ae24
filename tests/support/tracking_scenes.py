"""Clusters that move on known paths, for the tests of tracking and of anomalies."""

from __future__ import annotations

from typing import Any

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F64, Boxes3D, Frame
from bevviz.model.results import Clusters, Objects

PERSON, CAR = (0.6, 0.5, 1.7), (4.4, 1.8, 1.5)
START = 1_700_000_000_000_000_000


def scene(
    index: float,
    places: Any,
    sizes: Any = PERSON,
    names: tuple[str, ...] = (),
    *,
    yaw: Any = 0.0,
    pose: F64 | None = None,
    lost: bool = False,
) -> tuple[Frame, Clusters, Objects]:
    """Frame ``index`` at 10 Hz: clusters at these places of the fixed frame, the first ones named."""
    world = np.eye(4) if pose is None else pose
    count = len(places)
    center = geometry.apply(geometry.inverse(world), np.array(places, np.float32).reshape(-1, 3))
    size = np.broadcast_to(np.array(sizes, np.float32), (count, 3))
    turn = np.broadcast_to(np.array(yaw, np.float32), count) - np.float32(geometry.yaw(world))
    boxes = Boxes3D(center, size, turn.astype(np.float32))
    i = np.zeros(count, np.int32)
    clusters = Clusters(np.zeros(0, np.int32), i, i + 50, center, boxes, boxes)
    rows = np.arange(len(names), dtype=np.int32)
    named = Boxes3D(center[rows], size[rows], turn[rows].astype(np.float32))
    objects = Objects(named, names, np.full(len(rows), 0.8, np.float32), rows, ("zed",) * len(rows), rows)
    frame = Frame(
        index=int(index),
        stamp=START + round(index * 1e8),
        received=0,
        lidar="lidar",
        points=np.zeros((0, 3), np.float32),
        points_frame="lidar",
        world_frame="map",
        world_from_points=None if lost else world,
    )
    return frame, clusters, objects
