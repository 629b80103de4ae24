"""Overlap of upright boxes of any yaw, seen from above and as volumes."""

from __future__ import annotations

import math

import numpy as np

from bevviz.model.frame import F32, F64, Boxes3D
from bevviz.model.geometry import corners
from bevviz.support.numba_kernel import kernel


def bev_iou(a: Boxes3D, b: Boxes3D) -> F32:
    """Return the (A, B) intersection over union of A and B boxes, seen from above."""
    shared = _shared_area(a, b)
    return _ratio(shared, _areas(a)[:, None] + _areas(b) - shared)


def box_iou(a: Boxes3D, b: Boxes3D) -> tuple[F32, F32]:
    """Return the (A, B) intersection over union of A and B boxes, seen from above and as volumes."""
    area = _shared_area(a, b)
    (low_a, high_a), (low_b, high_b) = (
        (boxes.center[:, 2] - boxes.size[:, 2] / 2, boxes.center[:, 2] + boxes.size[:, 2] / 2)
        for boxes in (a, b)
    )
    height = np.minimum(high_a[:, None], high_b[None]) - np.maximum(low_a[:, None], low_b[None])
    volume = area * np.clip(height, 0, None)
    volume_a, volume_b = (np.prod(boxes.size, axis=1, dtype=np.float64) for boxes in (a, b))
    return (
        _ratio(area, _areas(a)[:, None] + _areas(b) - area),
        _ratio(volume, volume_a[:, None] + volume_b - volume),
    )


def bev_iou_and_share(a: Boxes3D, b: Boxes3D) -> tuple[F64, F64]:
    """Return the (A, B) intersection over union, and the share of the smaller box that lies in the other."""
    shared = _shared_area(a, b)
    area_a, area_b = _areas(a)[:, None], _areas(b)
    smaller = np.minimum(area_a, area_b)
    return shared / np.maximum(area_a + area_b - shared, 1e-9), shared / np.maximum(smaller, 1e-9)


def _shared_area(a: Boxes3D, b: Boxes3D) -> F64:
    """Return the (A, B) square metres that two boxes share, seen from above."""
    outlines_a, outlines_b = (np.ascontiguousarray(corners(boxes)[:, :4, :2], np.float64) for boxes in (a, b))
    return _shared_areas(outlines_a, outlines_b)


def _areas(boxes: Boxes3D) -> F64:
    """Return the (K,) square metres of boxes seen from above."""
    return np.asarray(np.prod(boxes.size[:, :2], axis=1, dtype=np.float64))


def _ratio(part: F64, whole: F64) -> F32:
    """Return the quotient, zero where the whole is zero."""
    return np.divide(part, whole, out=np.zeros(part.shape), where=whole > 0).astype(np.float32)


@kernel
def _shared_areas(a: F64, b: F64) -> F64:
    """Return the (A, B) areas that two outlines share."""
    shared = np.zeros((len(a), len(b)))
    for i in range(len(a)):
        reach_a = _diagonal(a[i])
        for j in range(len(b)):
            x, y = (
                a[i, 0, 0] + a[i, 2, 0] - b[j, 0, 0] - b[j, 2, 0],
                a[i, 0, 1] + a[i, 2, 1] - b[j, 0, 1] - b[j, 2, 1],
            )
            if math.hypot(x, y) < reach_a + _diagonal(b[j]):
                shared[i, j] = shared_area(a[i], b[j])
    return shared


@kernel
def _diagonal(outline: F64) -> float:
    """Return the length of the diagonal of a rectangle."""
    return math.hypot(outline[2, 0] - outline[0, 0], outline[2, 1] - outline[0, 1])


@kernel
def shared_area(a: F64, b: F64) -> float:
    """Return the common area of two counter-clockwise quadrangles.

    Sutherland and Hodgman 1974 for the clipping, the shoelace formula for the area.
    """
    polygon, clipped = np.empty((16, 2)), np.empty((16, 2))
    for k in range(4):
        polygon[k, 0], polygon[k, 1] = a[k, 0], a[k, 1]
    count = 4
    for k in range(4):
        x0, y0 = b[k]
        ex, ey = b[(k + 1) % 4, 0] - x0, b[(k + 1) % 4, 1] - y0
        kept = 0
        for m in range(count):
            x, y = polygon[m]
            px, py = polygon[m - 1 if m else count - 1]
            left = ex * (y - y0) - ey * (x - x0)
            before = ex * (py - y0) - ey * (px - x0)
            if (left >= 0) != (before >= 0):
                t = before / (before - left)
                clipped[kept, 0], clipped[kept, 1] = px + t * (x - px), py + t * (y - py)
                kept += 1
            if left >= 0:
                clipped[kept, 0], clipped[kept, 1] = x, y
                kept += 1
        polygon, clipped, count = clipped, polygon, kept
        if count < 3:
            return 0.0
    area = 0.0
    for m in range(count):
        x, y = polygon[m]
        px, py = polygon[m - 1 if m else count - 1]
        area += px * y - py * x
    return abs(area) / 2
