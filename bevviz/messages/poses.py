"""Vectors, quaternions and poses of ROS messages as numbers."""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F64

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]
UPRIGHT: Quaternion = (0.0, 0.0, 0.0, 1.0)  # no rotation


def vector_of(value: Any) -> Vector:
    """Return the numbers of a Vector3 or a Point, or of a list of three numbers."""
    x, y, z = (value.x, value.y, value.z) if hasattr(value, "x") else value
    return float(x), float(y), float(z)


def quaternion_of(value: Any) -> Quaternion:
    """Return the numbers x, y, z, w of a Quaternion."""
    return float(value.x), float(value.y), float(value.z), float(value.w)


def matrix_of(position: Vector, orientation: Quaternion) -> F64:
    """Return the (4, 4) matrix of a pose. An orientation of zeros is not set, and means no rotation.

    Raises:
        ValueError: the orientation is not finite.
    """
    return geometry.transform(position, orientation if any(orientation) else UPRIGHT)


def pose_of(pose: Any) -> F64:
    """Return the (4, 4) matrix of a Pose. An orientation that is not finite means no rotation, as in RViz."""
    orientation = quaternion_of(pose.orientation)
    return matrix_of(
        vector_of(pose.position), orientation if all(map(math.isfinite, orientation)) else UPRIGHT
    )


def yaw_of(quaternions: F64) -> F64:
    """Return the (...) rotations about z of (..., 4) quaternions xyzw of any length; 0 for a zero one."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    yaw: F64 = np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return yaw
