"""What several things that are logged are made of."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from bevviz import geometry
from bevviz.frame import F32, F64, I32, U8, Bool, Boxes3D
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


# --- points ------------------------------------------------------------------------------------
# In one pass each, as they are made for every frame.


@kernel
def picked(points: F32, mask: Bool, wanted: bool, scale: float) -> F32:
    """The points whose mask is ``wanted``, rounded to 1 / scale, which compresses to half; 0: exact."""
    count = 0
    for i in range(len(points)):
        count += mask[i] == wanted
    found = np.empty((count, 3), np.float32)
    factor, count = np.float32(scale), 0
    for i in range(len(points)):
        if mask[i] == wanted:
            for axis in range(3):
                value = points[i, axis]
                found[count, axis] = np.rint(value * factor) / factor if factor > 0 else value
            count += 1
    return found


@kernel
def classes(mask: Bool, inverse: I32, yes: int, no: int) -> NDArray[np.uint16]:
    """(N,) class of each raw point, by whether its voxel is in the mask."""
    found = np.empty(len(inverse), np.uint16)
    for i in range(len(inverse)):
        found[i] = yes if mask[inverse[i]] else no
    return found
