"""Rigid transforms, camera projection and boxes as plain functions of arrays."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from bevviz.model.frame import F32, F64, Bool, Boxes3D, Intrinsics

FloatArray = NDArray[Any]

MIN_DEPTH = 1e-3  # Least depth in metres. A point nearer to the camera's plane has no meaningful pixel.
# Largest squared slope of a ray, 0.006 degrees from the camera's plane. Its sixth power fits into float32.
WIDEST = 1e8
FISHEYE = ("equidistant", "fisheye")

# --- rigid transforms --------------------------------------------------------------------------


def transform(translation: Iterable[float], quaternion_xyzw: Iterable[float]) -> F64:
    """Return the (4, 4) matrix of a translation in metres and a rotation as quaternion x, y, z, w.

    The quaternion need not be of unit length. Published ones seldom are to the last digit.

    Raises:
        ValueError: the quaternion has zero length or is not finite.
    """
    q = tuple(map(float, quaternion_xyzw))
    norm = math.hypot(*q)
    if not math.isfinite(norm) or norm < 1e-9:
        raise ValueError(f"{q} is no rotation")
    # Scalars are faster than NumPy for so few numbers, and a robot publishes hundreds of transforms a second.
    x, y, z, w = (value / norm for value in q)
    tx, ty, tz = map(float, translation)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), tx],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), ty],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), tz],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def transform_wxyz(translation: Iterable[float], quaternion_wxyz: Iterable[float]) -> F64:
    """Return the (4, 4) matrix of a translation and a quaternion w, x, y, z, as ``transform`` does."""
    w, x, y, z = quaternion_wxyz
    return transform(translation, (x, y, z, w))


def rotations(axis: int, angles: FloatArray) -> F64:
    """Return (N, 3, 3) rotations by (N,) angles in radians about x (0), y (1) or z (2)."""
    a, b = (axis + 1) % 3, (axis + 2) % 3
    turns = np.tile(np.eye(3), (len(angles), 1, 1))
    turns[:, a, a] = turns[:, b, b] = np.cos(angles)
    turns[:, b, a], turns[:, a, b] = np.sin(angles), -np.sin(angles)
    return turns


def inverse(a_from_b: F64) -> F64:
    """Return b_from_a for a rigid (4, 4) a_from_b."""
    rotation = a_from_b[:3, :3].T
    m = np.eye(4)
    m[:3, :3] = rotation
    m[:3, 3] = -rotation @ a_from_b[:3, 3]
    return m


def quaternion(a_from_b: F64) -> F64:
    """Return the (4,) unit quaternion x, y, z, w, w >= 0, of a (4, 4) transform (Shepperd 1978)."""
    (a, b, c), (d, e, f), (g, h, i) = a_from_b[:3, :3].tolist()  # scalars for speed, as in ``transform``
    squared = a - e - i, e - a - i, i - a - e, a + e + i
    largest = squared.index(max(squared))
    root = squared[largest] + 1
    q = (
        (root, b + d, c + g, h - f),
        (b + d, root, f + h, c - g),
        (c + g, f + h, root, d - b),
        (h - f, c - g, d - b, root),
    )[largest]
    scale = math.copysign(1 / math.hypot(*q), q[3])
    return np.array([value * scale for value in q])


def interpolate(a_from_b0: F64, a_from_b1: F64, t: float) -> F64:
    """Return the pose between two: linear translation, rotation by slerp (Shoemake 1985), t in [0, 1]."""
    q0, q1 = quaternion(a_from_b0), quaternion(a_from_b1)
    dot = float(q0 @ q1)
    if dot < 0:
        q1, dot = -q1, -dot
    angle = float(np.arccos(min(dot, 1.0)))
    if angle < 1e-6:
        q = q0 + t * (q1 - q0)
    else:
        q = (np.sin((1 - t) * angle) * q0 + np.sin(t * angle) * q1) / np.sin(angle)
    return transform(a_from_b0[:3, 3] * (1 - t) + a_from_b1[:3, 3] * t, q)


def apply(a_from_b: F64, points: FloatArray) -> F32:
    """Transform (N, 3) points from frame b to frame a, as float32."""
    m = np.asarray(a_from_b, np.float32)
    moved: F32 = np.asarray(points, np.float32) @ m[:3, :3].T
    moved += m[:3, 3]
    return moved


def yaw(a_from_b: F64) -> float:
    """Return the rotation about z in radians."""
    return float(np.arctan2(a_from_b[1, 0], a_from_b[0, 0]))


# --- cameras -----------------------------------------------------------------------------------


def project(points: FloatArray, intrinsics: Intrinsics) -> tuple[F32, F32]:
    """Project points of the optical frame into the image.

    Models as in OpenCV and ROS: plumb_bob (Brown-Conrady), rational_polynomial with OpenCV's thin prism and
    tilted sensor, equidistant (Kannala-Brandt 2006).

    Args:
        points: (N, 3) metres in the optical frame.
        intrinsics: camera model.

    Returns:
        uv: (N, 2) float32 pixels, not clipped to the image. NaN behind the camera, and where the distortion
            polynomial has folded over (far outside the calibrated field of view).
        depth: (N,) float32 metres along the optical axis.
    """
    p = np.asarray(points)
    depth = np.asarray(p[:, 2], np.float32)
    inv = np.full(len(p), np.nan, p.dtype if p.dtype.kind == "f" else np.float64)
    np.divide(1.0, p[:, 2], out=inv, where=p[:, 2] > MIN_DEPTH)
    x, y = p[:, 0] * inv, p[:, 1] * inv
    if has_distortion(intrinsics):
        x, y = _distort(x, y, intrinsics)
    k = intrinsics.K
    uv = np.empty((len(p), 2), np.float32)
    uv[:, 0] = float(k[0, 0]) * x + float(k[0, 2])
    uv[:, 1] = float(k[1, 1]) * y + float(k[1, 2])
    return uv, depth


def has_distortion(intrinsics: Intrinsics) -> bool:
    """Return whether straight lines are curved in the image.

    An equidistant lens curves them even without coefficients.
    """
    return intrinsics.distortion_model in FISHEYE or bool(np.any(intrinsics.D))


def rays(uv: FloatArray, intrinsics: Intrinsics) -> F64:
    """Return (N, 3) directions, z = 1, in the optical frame of (N, 2) pixels: the inverse of ``project``."""
    import cv2

    points = np.ascontiguousarray(uv, np.float64).reshape(-1, 1, 2)
    rays = np.ones((len(points), 3))
    if len(points) == 0:
        return rays
    d, criteria = coefficients(intrinsics), (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    if intrinsics.distortion_model in FISHEYE:
        flat = cv2.fisheye.undistortPoints(points, intrinsics.K, d[:4], criteria=criteria)
    else:
        flat = cv2.undistortPoints(points, intrinsics.K, d, criteria=criteria)
    rays[:, :2] = flat.reshape(-1, 2)
    return rays


def frustum(
    xyxy: FloatArray, intrinsics: Intrinsics, near: FloatArray | float, far: FloatArray | float
) -> F32:
    """Return the (D, 8, 3) corners, in the optical frame, of the frustums of (D, 4) image boxes.

    ``near`` and ``far`` are depths in metres along the optical axis, one for all boxes or (D,). The corners
    run top left, top right, bottom right, bottom left, first at ``near``, then at ``far``.
    """
    directions = rays(np.asarray(xyxy)[:, [0, 1, 2, 1, 2, 3, 0, 3]].reshape(-1, 2), intrinsics).reshape(
        -1, 1, 4, 3
    )
    depths = np.stack([np.broadcast_to(d, len(xyxy)) for d in (near, far)], axis=1)
    return np.asarray(directions * depths[:, :, None, None], np.float32).reshape(-1, 8, 3)


def coefficients(intrinsics: Intrinsics) -> F64:
    """Return the (14,) distortion coefficients in the order of OpenCV, zero if not stated."""
    d = np.zeros(14)
    stated = np.ravel(intrinsics.D)[:14]
    d[: len(stated)] = stated
    return d


def _distort(x: FloatArray, y: FloatArray, intrinsics: Intrinsics) -> tuple[FloatArray, FloatArray]:
    """Distort normalised image coordinates. Return NaN where the polynomial folds over."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, *tilt = coefficients(intrinsics).tolist()
    r2 = x * x + y * y
    if intrinsics.distortion_model in FISHEYE:
        k1, k2, k3, k4 = coefficients(intrinsics)[:4].tolist()
        r = np.sqrt(r2)
        theta = np.arctan(r)
        t2 = theta * theta
        t2 = np.where(t2 < _first_root(Polynomial([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4])), t2, np.nan)
        turned = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        scale = np.divide(turned, r, out=np.ones_like(r), where=r > 1e-8)
        return x * scale, y * scale
    # r * numerator / denominator must grow with r. This is its derivative, times denominator^2, in r^2:
    numerator, denominator = Polynomial([1, k1, k2, k3]), Polynomial([1, k4, k5, k6])
    turns = numerator.deriv() * denominator - numerator * denominator.deriv()
    slope = numerator * denominator + Polynomial([0, 2]) * turns
    r2 = np.where(r2 < min(_first_root(slope), _first_root(denominator), WIDEST), r2, np.nan)
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    if s1 or s2 or s3 or s4:  # thin prism
        u, v = u + r2 * (s1 + r2 * s2), v + r2 * (s3 + r2 * s4)
    return _tilted(u, v, *tilt) if any(tilt) else (u, v)


def _tilted(u: FloatArray, v: FloatArray, about_x: float, about_y: float) -> tuple[FloatArray, FloatArray]:
    """Project normalised image coordinates onto a sensor that is tilted by two angles, as OpenCV does."""
    cx, sx, cy, sy = np.cos(about_x), np.sin(about_x), np.cos(about_y), np.sin(about_y)
    turned = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ [[1, 0, 0], [0, cx, sx], [0, -sx, cx]]
    onto = [[turned[2, 2], 0, -turned[0, 2]], [0, turned[2, 2], -turned[1, 2]], [0, 0, 1]] @ turned
    (a, b, c), (d, e, f), (g, h, i) = onto.tolist()
    scale = 1 / (g * u + h * v + i)
    return scale * (a * u + b * v + c), scale * (d * u + e * v + f)


def _first_root(polynomial: Polynomial) -> float:
    """Return the least positive root, or infinity."""
    roots = polynomial.trim().roots()
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(real.min(initial=np.inf))


# --- boxes -------------------------------------------------------------------------------------


def iou(a: FloatArray, b: FloatArray) -> F32:
    """Return the (A, B) intersection over union of (A, 4) and (B, 4) image boxes x0, y0, x1, y1.

    A box that is empty or NaN has zero overlap.
    """
    (ax0, ay0, ax1, ay1), (bx0, by0, bx1, by1) = a.T[:, :, None], b.T
    inter = np.maximum(np.minimum(ax1, bx1) - np.maximum(ax0, bx0), 0)
    inter *= np.maximum(np.minimum(ay1, by1) - np.maximum(ay0, by0), 0)
    area_a, area_b = (
        np.maximum(x1 - x0, 0) * np.maximum(y1 - y0, 0)
        for x0, y0, x1, y1 in ((ax0, ay0, ax1, ay1), (bx0, by0, bx1, by1))
    )
    union = area_a + area_b - inter
    ratio = np.zeros(inter.shape, np.float32)
    np.divide(inter, union, out=ratio, where=union > 0, casting="same_kind")
    return ratio


def corners(boxes: Boxes3D) -> F32:
    """Return (K, 8, 3) corners: the lower four counter-clockwise seen from above, then the upper four."""
    unit = np.array(
        [[1, 1, -1], [-1, 1, -1], [-1, -1, -1], [1, -1, -1], [1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]],
        np.float32,
    )
    local = unit[None] * (boxes.size[:, None] / 2)
    c, s = np.cos(boxes.yaw)[:, None], np.sin(boxes.yaw)[:, None]
    turned = np.stack(
        [c * local[..., 0] - s * local[..., 1], s * local[..., 0] + c * local[..., 1], local[..., 2]], -1
    )
    return np.asarray(turned + boxes.center[:, None], np.float32)


def transform_boxes(boxes: Boxes3D, b_from_a: F64) -> Boxes3D:
    """Transform upright boxes from frame a to frame b, which is also upright.

    Frame a may be a map with its origin far away.
    """
    turned = boxes.yaw + np.float32(yaw(b_from_a))
    center = np.asarray(boxes.center, np.float64) @ b_from_a[:3, :3].T + b_from_a[:3, 3]
    return Boxes3D(center.astype(np.float32), boxes.size, turned)


def upright_boxes(center: F64, size: F32, turns: F64) -> Boxes3D:
    """Convert boxes of any rotation to upright ones, which have the same axes up to a lean.

    The axis nearest to the vertical is the height. The heading is that of x, or of y if x is the height.

    Args:
        center: (K, 3).
        size: (K, 3) along the box's own axes.
        turns: (K, 3, 3) rotation of each box.
    """
    rows = np.arange(len(turns))
    height = np.abs(turns[:, 2]).argmax(axis=1)
    along = np.where(height == 0, 1, 0)
    lengths = size[rows[:, None], np.stack([along, 3 - height - along, height], axis=1)]
    ahead = turns[rows, :, along]
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    return Boxes3D(center.astype(np.float32), lengths, heading.astype(np.float32))


def inside(points: F32, boxes: Boxes3D, k: int) -> Bool:
    """Return the (N,) mask of the points in box k. Its surface counts."""
    offset = points - boxes.center[k]
    is_inside = np.zeros(len(points), np.bool_)
    near = np.flatnonzero((np.abs(offset[:, :2]) <= np.hypot(*boxes.size[k, :2]) / 2).all(axis=1))
    x, y, z = offset[near].T
    c, s = np.cos(boxes.yaw[k]), np.sin(boxes.yaw[k])
    local = np.column_stack([c * x + s * y, c * y - s * x, z])
    is_inside[near] = (np.abs(local) <= boxes.size[k] / 2).all(axis=1)
    return is_inside
