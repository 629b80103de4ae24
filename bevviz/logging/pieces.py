"""What several things that are logged are made of."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr

from bevviz import geometry
from bevviz.frame import F32, F64, U8, Boxes3D
from bevviz.stages.kernel import kernel

CORNER = 0.5  # pixels: Rerun counts from the corner of the first pixel, bevviz from its centre


def transform(world_from_entity: F64) -> rr.Transform3D:
    return rr.Transform3D(
        translation=world_from_entity[:3, 3],
        quaternion=rr.Quaternion(xyzw=geometry.quaternion(world_from_entity)),
    )


def boxes3d(boxes: Boxes3D, rows: np.ndarray[Any, Any], labels: list[str], **looks: Any) -> rr.Boxes3D:
    half = boxes.yaw[rows] / 2
    turns = np.zeros((len(rows), 4), np.float32)
    turns[:, 2], turns[:, 3] = np.sin(half), np.cos(half)
    return rr.Boxes3D(
        centers=boxes.center[rows], sizes=boxes.size[rows], quaternions=turns, labels=labels, **looks
    )


def blob(data: U8) -> pa.Array:
    """(N,) bytes as Rerun keeps them, without the copies that it would make of them."""
    one = pa.list_(pa.field("item", pa.uint8(), nullable=False))
    return pa.ListArray.from_arrays(pa.array([0, len(data)], pa.int32()), pa.array(data), type=one)


@kernel
def rounded(points: F32, scale: float) -> F32:
    """To the nearest 1 / scale, in one pass, as it is done to every frame."""
    found, factor = np.empty_like(points), np.float32(scale)
    for i in range(len(points)):
        for axis in range(3):
            found[i, axis] = np.rint(points[i, axis] * factor) / factor
    return found
