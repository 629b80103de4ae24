"""Points in many boxes at once, found in one pass over the cloud."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bevviz.model.frame import F32, F64, I64, Boxes3D
from bevviz.support.numba_kernel import kernel

CELLS = 64  # cells along each side of the grid in which rectangles are looked up; the last holds the edge
ROUNDING = 1e-3  # metres


def inside_each(points: F32, boxes: Boxes3D) -> Iterator[tuple[int, I64]]:
    """Iterate over the boxes, with the ascending rows of the points inside. The surface counts."""
    reach = np.hypot(boxes.size[:, 0], boxes.size[:, 1]).astype(np.float64)[:, None] / 2 + ROUNDING
    center = boxes.center[:, :2].astype(np.float64)
    first, near = rows_in_rectangles(points, center - reach, center + reach)
    box = np.repeat(np.arange(len(boxes)), np.diff(first))
    x, y, z = (points[near] - boxes.center[box]).T
    c, s = np.cos(boxes.yaw)[box], np.sin(boxes.yaw)[box]
    local = np.column_stack([c * x + s * y, c * y - s * x, z])
    is_inside = (np.abs(local) <= boxes.size[box] / 2).all(axis=1)
    ends = np.searchsorted(box[is_inside], np.arange(1, len(boxes)))
    yield from enumerate(np.split(near[is_inside], ends) if len(boxes) else [])


@kernel
def rows_in_rectangles(points: F32, low: F64, high: F64) -> tuple[I64, I64]:
    """Find the points in rectangles of the ground plane. The lower edges belong to a rectangle.

    Args:
        points: (N, 3).
        low: (K, 2) least x and y of each rectangle.
        high: (K, 2) greatest x and y.

    Returns:
        first: (K + 1,) where the rows of each rectangle begin.
        rows: ascending rows of the points of all rectangles, one rectangle after the other.
    """
    count = len(low)
    if not count or not len(points):
        return np.zeros(count + 1, np.int64), np.empty(0, np.int64)
    start = np.full(2, np.inf)
    end = np.full(2, -np.inf)
    for k in range(count):
        for axis in range(2):
            start[axis], end[axis] = min(start[axis], low[k, axis]), max(end[axis], high[k, axis])
    least, most = np.full(2, np.inf), np.full(2, -np.inf)  # of the points, which a huge rectangle exceeds
    for i in range(len(points)):
        for axis in range(2):
            least[axis], most[axis] = min(least[axis], points[i, axis]), max(most[axis], points[i, axis])
    scale = np.zeros(2)
    for axis in range(2):
        start[axis], end[axis] = max(start[axis], least[axis]), min(end[axis], most[axis])
        if end[axis] > start[axis]:
            scale[axis] = (CELLS - 1) / (end[axis] - start[axis])

    # The rectangles of each cell, one cell after the other.
    corner = np.zeros((count, 4), np.int64)
    of_cell = np.zeros(CELLS * CELLS + 1, np.int64)
    for k in range(count):
        for axis in range(2):
            if low[k, axis] <= high[k, axis]:
                corner[k, axis] = _cell(low[k, axis], start[axis], scale[axis], end[axis])
                corner[k, 2 + axis] = _cell(high[k, axis], start[axis], scale[axis], end[axis])
            else:  # NaN holds no point.
                corner[k, 2 + axis] = -1
        for row in range(corner[k, 0], corner[k, 2] + 1):
            for column in range(corner[k, 1], corner[k, 3] + 1):
                of_cell[row * CELLS + column + 1] += 1
    _add_up(of_cell)
    filled = of_cell.copy()
    rectangles = np.empty(of_cell[-1], np.int64)
    for k in range(count):
        for row in range(corner[k, 0], corner[k, 2] + 1):
            for column in range(corner[k, 1], corner[k, 3] + 1):
                rectangles[filled[row * CELLS + column]] = k
                filled[row * CELLS + column] += 1

    # The first pass counts, the second one writes.
    first = np.zeros(count + 1, np.int64)
    rows = np.empty(0, np.int64)
    for is_counted in (False, True):
        if is_counted:
            _add_up(first)
            rows = np.empty(first[-1], np.int64)
        place = first.copy()
        for i in range(len(points)):
            x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
            if not (start[0] <= x <= end[0] and start[1] <= y <= end[1]):
                continue
            cell = int((x - start[0]) * scale[0]) * CELLS + int((y - start[1]) * scale[1])
            for j in range(of_cell[cell], of_cell[cell + 1]):
                k = rectangles[j]
                if low[k, 0] <= x < high[k, 0] and low[k, 1] <= y < high[k, 1]:
                    if is_counted:
                        rows[place[k]] = i
                        place[k] += 1
                    else:
                        first[k + 1] += 1
    return first, rows


@kernel
def _cell(value: float, start: float, scale: float, end: float) -> int:
    """Return the cell of a coordinate along one axis. Values outside the grid are in its outer cells."""
    return int((min(value, end) - start) * scale) if value > start else 0


@kernel
def _add_up(counts: I64) -> None:
    """Replace each number by the sum up to it. ``np.cumsum`` would make Numba import scipy.linalg."""
    for k in range(1, len(counts)):
        counts[k] += counts[k - 1]
