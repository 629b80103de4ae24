"""What several things that are logged are made of."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr

from bevviz import geometry
from bevviz.frame import F64, Boxes3D

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
