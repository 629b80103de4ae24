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
    points: F64, normals: F64, edge: F64, prior: F64, longest: float, about: float
) -> tuple[F64, I64, float]:
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
    - how much nearer than any point a side that faces the sensor lies.

    Args:
        points: (N, 2) metres from the sensor.
        normals: (2, 2) outward normals of the planes through the sensor and the left and right edge of the
            image box.
        edge: (2,) one sigma of these edges in metres at the object, ``NO_EDGE`` for none.
        prior: (4,) mean and spread of the class's length, then of its width; NaN for none.
        longest: metres, longest side of the box without a prior. With a prior its own limits apply.
        about: approximate heading, right to a few degrees; NaN if none is known.

    Returns:
        (5,) x and y of the centre, length, width and heading.
        (2,) sides that face the sensor, along the heading and across it: -1 lower, 1 upper, 0 none.
        The minimised cost.
    """
    known = not np.isnan(prior[0])
    most = np.full(2, longest)
    if known:
        most[0], most[1] = prior[0] + MAX_SPREAD * prior[1], prior[2] + MAX_SPREAD * prior[3]
    step = (len(points) + MAX_FIT_POINTS - 1) // MAX_FIT_POINTS
    n = (len(points) + step - 1) // step
    x, y = np.empty(n), np.empty(n)
    for i in range(n):
        x[i], y[i] = points[i * step]

    best, box, facing = np.inf, np.zeros(5), np.zeros(2, np.int64)
    seen, sides, u, v = np.empty(4), np.zeros(2, np.int64), np.empty(n), np.empty(n)
    along, across = np.empty((13, 3)), np.empty((13, 3))
    coarse = about
    for t in range(HEADINGS if not np.isnan(about) else 0, HEADINGS + 9):
        heading = math.pi * t / HEADINGS if t < HEADINGS else coarse + math.radians(t - HEADINGS - 4)
        c, s = math.cos(heading), math.sin(heading)
        for i in range(n):
            u[i], v[i] = c * x[i] + s * y[i], c * y[i] - s * x[i]
        _extent(u, most[0], seen[:2])
        _extent(v, most[1], seen[2:])
        sides[0] = _facing(seen[0], seen[1])
        sides[1] = _facing(seen[2], seen[3])
        base = TOTAL_WEIGHT * _closeness(u, v, seen, sides)
        if base < best:
            if known:
                many = _full_extents(seen[0], seen[1], sides[0], prior[0], prior[1], along)
                wide = _full_extents(seen[2], seen[3], sides[1], prior[2], prior[3], across)
            else:
                along[0], across[0] = (seen[0], seen[1], 0.0), (seen[2], seen[3], 0.0)
                many = wide = 1
            for i in range(many):
                if base + along[i, 2] >= best:
                    continue
                for j in range(wide):
                    cost = base + along[i, 2] + across[j, 2]
                    for k in range(2):
                        if cost < best and edge[k] < NO_EDGE:
                            nu = c * normals[k, 0] + s * normals[k, 1]
                            nv = c * normals[k, 1] - s * normals[k, 0]
                            off = nu * along[i, 1 if nu > 0 else 0] + nv * across[j, 1 if nv > 0 else 0]
                            z = off / edge[k] / EDGE_TAIL
                            cost += 0.5 * EDGE_TAIL**2 * math.log1p(z * z)
                    if cost < best:
                        best = cost
                        mu, mv = (along[i, 0] + along[i, 1]) / 2, (across[j, 0] + across[j, 1]) / 2
                        box[0], box[1] = c * mu - s * mv, s * mu + c * mv
                        box[2], box[3] = along[i, 1] - along[i, 0], across[j, 1] - across[j, 0]
                        box[4] = heading
                        facing[0], facing[1] = sides[0], sides[1]
        if t == HEADINGS - 1:
            coarse = box[4]
    return box, facing, best


@kernel
def _extent(values: F64, most: float, out: F64) -> None:
    """Write the lowest and the highest value to ``out``, without strays.

    If they are more than ``most`` apart, write the densest interval of that length.
    """
    n = len(values)
    strays = int(STRAY_SHARE * n)
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
    if out[1] - out[0] <= most:
        return
    ordered = np.sort(values)
    largest, end = 0, 0
    for begin in range(n):
        while end < n and ordered[end] - ordered[begin] <= most:
            end += 1
        if end - begin > largest:
            largest = end - begin
            out[0], out[1] = ordered[begin], ordered[end - 1]


@kernel
def _facing(low: float, high: float) -> int:
    """Return which of two opposite sides faces the sensor at 0: -1 the lower, 1 the upper, 0 none."""
    return -1 if low > 0 else (1 if high < 0 else 0)


@kernel
def _closeness(u: F64, v: F64, seen: F64, sides: I64) -> float:
    """Return the mean distance of the points from the sides that face the sensor, in NEAR_SIDE.

    The distance of a point is at most MAX_SIDE_DISTANCE.
    """
    total = 0.0
    for i in range(len(u)):
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
