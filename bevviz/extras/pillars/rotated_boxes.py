"""Greedy non-maximum suppression of rotated boxes seen from above."""

from __future__ import annotations

import numpy as np

from bevviz.model.box_overlap import shared_area
from bevviz.model.frame import F64, I64, Bool
from bevviz.support.numba_kernel import kernel


def survivors(boxes: F64, group: I64, iou: float, distance: float) -> Bool:
    """Return which boxes survive greedy suppression within their group.

    Suppression by distance comes first, as in Autoware. A box that it removes suppresses nothing more.

    Args:
        boxes: (K, 7) x, y, z, length, width, height, yaw, best score first.
        group: (K,) only boxes of the same group suppress each other.
        iou: intersection over union seen from above; a weaker box above it is suppressed. 1 disables this.
        distance: metres between the centres seen from above; a weaker box below it is suppressed. 0 disables
            this.

    Returns:
        (K,) mask of survivors.
    """
    alive = np.ones(len(boxes), np.bool_)
    flat = np.ascontiguousarray(boxes[:, [0, 1, 3, 4, 6]], np.float64)
    if distance > 0:
        _by_distance(flat, group, distance, alive)
    if iou < 1:
        _by_overlap(flat, group, iou, alive)
    return alive


@kernel
def _by_distance(boxes: F64, group: I64, distance: float, alive: Bool) -> None:
    """Suppress boxes whose centre is near that of a better box."""
    for i in range(len(boxes)):
        if not alive[i]:
            continue
        for j in range(i + 1, len(boxes)):
            if alive[j] and group[i] == group[j]:
                dx, dy = boxes[i, 0] - boxes[j, 0], boxes[i, 1] - boxes[j, 1]
                if dx * dx + dy * dy < distance * distance:
                    alive[j] = False


@kernel
def _by_overlap(boxes: F64, group: I64, threshold: float, alive: Bool) -> None:
    """Suppress boxes that overlap a better box."""
    n = len(boxes)
    outline = np.empty((n, 4, 2))
    reach = np.empty(n)
    for i in range(n):
        x, y, length, width, yaw = boxes[i]
        c, s = np.cos(yaw), np.sin(yaw)
        reach[i] = np.sqrt(length * length + width * width) / 2
        for k in range(4):
            u = length / 2 if k in (0, 3) else -length / 2
            v = width / 2 if k < 2 else -width / 2
            outline[i, k, 0], outline[i, k, 1] = x + c * u - s * v, y + s * u + c * v
    for i in range(n):
        if not alive[i]:
            continue
        for j in range(i + 1, n):
            if not alive[j] or group[i] != group[j]:
                continue
            dx, dy = boxes[i, 0] - boxes[j, 0], boxes[i, 1] - boxes[j, 1]
            if dx * dx + dy * dy >= (reach[i] + reach[j]) ** 2:
                continue
            shared = shared_area(outline[i], outline[j])
            whole = boxes[i, 2] * boxes[i, 3] + boxes[j, 2] * boxes[j, 3] - shared
            if shared > threshold * whole:
                alive[j] = False
