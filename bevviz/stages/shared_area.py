"""Common area of two rotated boxes, seen from above."""

from __future__ import annotations

import numpy as np

from bevviz.model.frame import F64
from bevviz.support.kernel import kernel


@kernel
def shared_area(a: F64, b: F64) -> float:
    """Return the common area of two counter-clockwise quadrangles.

    Sutherland and Hodgman 1974 for the clipping, the shoelace formula for the area.
    """
    polygon, clipped = np.empty((16, 2)), np.empty((16, 2))
    polygon[:4] = a
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
