"""Fit boxes with plausible class sizes around the visible part of an object."""

from __future__ import annotations

import math

import numpy as np

from bevviz.model.frame import F64, I64
from bevviz.support.numba_kernel import kernel

HEADINGS = 36  # headings tried in a half turn; then every degree near the best
STRAY_SHARE = 0.02  # share of the points that may lie outside on each side
NEAR_SIDE = 0.1  # metres: unit of a point's distance from a side, and tolerance of the box for points outside
MAX_SIDE_DISTANCE = 3.0  # largest distance of a point from a side, in NEAR_SIDE
TOTAL_WEIGHT = 10.0  # all points count as this many, because points of one surface are not independent
OUTSIDE_COST = 2.0  # a point outside the box costs this many times the largest distance
HIDDEN_SIDE = 0.3  # metres, one sigma: gap between a side that faces the sensor and the nearest point
EDGE_TAIL = 3.0  # sigmas: beyond them an edge of the image box more likely belongs to an occluder
MAX_SPREAD = 2.5  # sigmas by which an object may exceed the mean size of its class
MAX_FIT_POINTS = 128  # points used for a fit, evenly spread

NO_EDGE = np.inf  # sigma of an edge without information, such as the border of the image


@kernel
def fit(
    points: F64, normals: F64, edge: F64, sizes: F64, bounds: F64, longest: float, about: float
) -> tuple[F64, I64, int]:
    """Fit the box, seen from above, that best explains the points of an object.

    Every heading is tried. Along both of its axes the box contains the points. Where they are shorter than
    the mean of the class, the box extends behind them, as seen from the sensor, within the spread of the
    class. The minimised cost is the sum, in squared sigmas, of

    - the distances of the points from the nearer of the sides that face the sensor, where surfaces are. This
      is the L-shape of Zhang et al. 2017, with truncated distances instead of their reciprocals, so that
      points seen through a window count little;
    - the deviations of length and width from those of the class;
    - the distances of the silhouette from the left and right edges of the image box, with Cauchy tails,
      because an edge may belong to an occluder;
    - how much nearer than any point a side that faces the sensor lies;
    - the bound of the size.

    Args:
        points: (N, 2) metres from the sensor.
        normals: (2, 2) outward normals of the planes through the sensor and the left and right edge of the
            image box.
        edge: (2,) one sigma of these edges in metres at the object, ``NO_EDGE`` for none.
        sizes: (M, 6) length, width and height of each size of the class, then their spreads. NaN for none.
        bounds: (M,) cost of each size without the points, ascending.
        longest: metres, longest side of the box without a size. A size has its own limits.
        about: approximate heading, right to a few degrees; NaN if none is known.

    Returns:
        (5,) x and y of the centre, length, width and heading.
        (2,) sides that face the sensor, along the heading and across it: -1 lower, 1 upper, 0 none.
        The row of the size.
    """
    step = (len(points) + MAX_FIT_POINTS - 1) // MAX_FIT_POINTS
    n = (len(points) + step - 1) // step
    x, y = np.empty(n), np.empty(n)
    for i in range(n):
        x[i], y[i] = points[i * step]

    least, number, box, facing = np.inf, 0, np.zeros(5), np.zeros(2, np.int64)
    flat, toward, most = np.zeros(5), np.zeros(2, np.int64), np.full(2, longest)
    seen, sides, u, v = np.empty(4), np.zeros(2, np.int64), np.empty(n), np.empty(n)
    along, across = np.empty((15, 3)), np.empty((15, 3))
    # All sizes try the same headings, but for the degrees near the best heading of each.
    is_open = np.isnan(about)
    extents, closeness = np.empty((HEADINGS + 9, 4)), np.full(HEADINGS + 9, -1.0)
    for k in range(len(sizes)):
        if bounds[k] >= least:  # The cost of the points is never negative.
            break
        length, width, long_spread, wide_spread = sizes[k, 0], sizes[k, 1], sizes[k, 3], sizes[k, 4]
        known = not np.isnan(length)
        if known:
            most[0], most[1] = length + MAX_SPREAD * long_spread, width + MAX_SPREAD * wide_spread
        best, coarse = np.inf, about
        for t in range(0 if is_open else HEADINGS, HEADINGS + 9):
            heading = math.pi * t / HEADINGS if t < HEADINGS else coarse + math.radians(t - HEADINGS - 4)
            c, s = math.cos(heading), math.sin(heading)
            for i in range(n):
                u[i], v[i] = c * x[i] + s * y[i], c * y[i] - s * x[i]
            is_shared = t < HEADINGS or not is_open
            if k == 0 or not is_shared:
                _extent(u, extents[t, :2])
                _extent(v, extents[t, 2:])
            for i in range(4):
                seen[i] = extents[t, i]
            is_cut = _cut(u, most[0], seen[:2])
            is_cut |= _cut(v, most[1], seen[2:])
            sides[0] = _facing(seen[0], seen[1])
            sides[1] = _facing(seen[2], seen[3])
            base = closeness[t]
            if base < 0 or is_cut or not is_shared:
                is_last = k + 1 == len(sizes) or not is_shared
                # Rounding cannot bring a sum above this limit below the best cost.
                enough = best / TOTAL_WEIGHT * n * (1 + 1e-9) if is_last else np.inf
                base = TOTAL_WEIGHT * _closeness(u, v, seen, sides, enough)
                if not is_cut and is_shared:
                    closeness[t] = base
            if base < best:
                if known:
                    many = _full_extents(seen[0], seen[1], sides[0], length, long_spread, along)
                    wide = _full_extents(seen[2], seen[3], sides[1], width, wide_spread, across)
                else:
                    along[0], across[0] = (seen[0], seen[1], 0.0), (seen[2], seen[3], 0.0)
                    many = wide = 1
                for i in range(many):
                    if base + along[i, 2] >= best:
                        continue
                    for j in range(wide):
                        cost = base + along[i, 2] + across[j, 2]
                        for side in range(2):
                            if cost < best and edge[side] < NO_EDGE:
                                nu = c * normals[side, 0] + s * normals[side, 1]
                                nv = c * normals[side, 1] - s * normals[side, 0]
                                off = nu * along[i, 1 if nu > 0 else 0] + nv * across[j, 1 if nv > 0 else 0]
                                z = off / edge[side] / EDGE_TAIL
                                cost += 0.5 * EDGE_TAIL**2 * math.log1p(z * z)
                        if cost < best:
                            best = cost
                            mu, mv = (along[i, 0] + along[i, 1]) / 2, (across[j, 0] + across[j, 1]) / 2
                            flat[0], flat[1] = c * mu - s * mv, s * mu + c * mv
                            flat[2], flat[3] = along[i, 1] - along[i, 0], across[j, 1] - across[j, 0]
                            flat[4] = heading
                            toward[0], toward[1] = sides[0], sides[1]
            if t == HEADINGS - 1:
                coarse = flat[4]
        if bounds[k] + best < least:
            least, number = bounds[k] + best, k
            for i in range(5):
                box[i] = flat[i]
            facing[0], facing[1] = toward[0], toward[1]
    return box, facing, number


@kernel
def _extent(values: F64, out: F64) -> None:
    """Write the lowest and the highest value to ``out``, without strays."""
    strays = int(STRAY_SHARE * len(values))
    low, high = np.full(strays + 1, np.inf), np.full(strays + 1, -np.inf)
    for value in values:
        k = strays
        if value < low[k]:
            while k > 0 and value < low[k - 1]:
                low[k] = low[k - 1]
                k -= 1
            low[k] = value
        k = strays
        if value > high[k]:
            while k > 0 and value > high[k - 1]:
                high[k] = high[k - 1]
                k -= 1
            high[k] = value
    out[0], out[1] = low[strays], high[strays]


@kernel
def _cut(values: F64, most: float, out: F64) -> bool:
    """Replace an interval longer than ``most`` by the densest one of that length. Return whether it was."""
    if out[1] - out[0] <= most:
        return False
    n = len(values)
    ordered = np.sort(values)
    largest, end = 0, 0
    for begin in range(n):
        while end < n and ordered[end] - ordered[begin] <= most:
            end += 1
        if end - begin > largest:
            largest = end - begin
            out[0], out[1] = ordered[begin], ordered[end - 1]
    return True


@kernel
def _facing(low: float, high: float) -> int:
    """Return which of two opposite sides faces the sensor at 0: -1 the lower, 1 the upper, 0 none."""
    return -1 if low > 0 else (1 if high < 0 else 0)


@kernel
def _closeness(u: F64, v: F64, seen: F64, sides: I64, enough: float) -> float:
    """Return the mean distance of the points from the sides that face the sensor, in NEAR_SIDE.

    The distance of a point is at most MAX_SIDE_DISTANCE. A sum above ``enough`` is not completed.
    """
    total = 0.0
    for i in range(len(u)):
        if total > enough:
            break
        if (
            u[i] < seen[0] - NEAR_SIDE
            or u[i] > seen[1] + NEAR_SIDE
            or v[i] < seen[2] - NEAR_SIDE
            or v[i] > seen[3] + NEAR_SIDE
        ):
            total += OUTSIDE_COST * MAX_SIDE_DISTANCE
            continue
        off = MAX_SIDE_DISTANCE * NEAR_SIDE
        if sides[0] != 0:
            off = min(off, abs(u[i] - (seen[0] if sides[0] < 0 else seen[1])))
        if sides[1] != 0:
            off = min(off, abs(v[i] - (seen[2] if sides[1] < 0 else seen[3])))
        total += off / NEAR_SIDE
    return total / len(u)


@kernel
def _full_extents(low: float, high: float, side: int, mean: float, spread: float, out: F64) -> int:
    """Write candidates for the full extent of an object seen from ``low`` to ``high``. Return their number.

    A candidate is a row of beginning, end and cost.
    """
    count = 0
    size = high - low
    for k in range(-2, 3):
        whole = mean + k * spread
        if whole <= size:
            if k < 2:
                continue
            whole = size
        z = (whole - mean) / spread
        hidden = whole - size
        for way in range(3 if hidden > 0 else 1):  # behind; towards the sensor; half of each
            behind = hidden if way == 0 else (0.0 if way == 1 else hidden / 2)
            below = behind if side > 0 else hidden - behind
            towards = 0.0 if side == 0 else min((hidden - behind) / HIDDEN_SIDE, 3.0)
            out[count, 0], out[count, 1] = low - below, high + hidden - below
            out[count, 2] = 0.5 * z * z + 0.5 * towards * towards
            count += 1
    return count
