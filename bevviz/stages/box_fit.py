"""Boxes of the size that a thing of its class can have, around the part of it that was seen."""

from __future__ import annotations

import math

import numpy as np

from bevviz.model.frame import F64, I64
from bevviz.support.kernel import kernel

HEADINGS = 36  # that are tried in a half turn, then every degree about the best
TRIM = 0.02  # share of the points on each side that may lie outside
NEAR_SIDE = 0.1  # metres from a side that are as good as on it, for a point
STRAY = 3.0  # as many NEAR_SIDE is a point off at most
WEIGHT = 10.0  # points of a surface are not independent: all of them count as this many
OUTSIDE = 2.0  # a point outside counts as this many that are as far off as can be
HIDDEN_SIDE = 0.3  # metres, one sigma, that a side towards the sensor may reach farther than was seen
EDGE_TAIL = 3.0  # sigmas from which an edge of the image box is rather one of what hides the object
MAX_SPREAD = 2.5  # sigmas of a size that a thing may have more than its class on average
FEW = 128  # points that are looked at, spread evenly

NO_EDGE = np.inf  # sigma of an edge that says nothing: that of the image


@kernel
def fit(points: F64, normals: F64, edge: F64, prior: F64, longest: float, about: float) -> tuple[F64, I64]:
    """The box, seen from above, that explains best what was seen of an object.

    Every heading is tried. Along both of its axes the box holds what was seen; where that is shorter than the
    class is on average, the box goes on behind it, as seen from the sensor, by what the class's spread
    allows. What is minimised is the sum, in squared sigmas, of

    - the distances of the points from the nearer of the sides that face the sensor, which is where surfaces
      are (the L-shape of Zhang et al. 2017, with distances that are cut off instead of their reciprocals, so
      that what is seen through a window counts little);
    - how far its length and width are from those of the class;
    - how far its silhouette is from the left and right edges of the image box, with the tails of Cauchy's
      distribution, since an edge may be that of something in front;
    - how far a side that faces the sensor lies nearer than any point.

    Args:
        points: (N, 2) metres from the sensor.
        normals: (2, 2) outward normals of the planes through the sensor and the image box's left, right edge.
        edge: (2,) one sigma in metres of those edges there, ``NO_EDGE`` for none.
        prior: (4,) mean and spread of the class's length, and of its width; NaN for none.
        longest: no side is longer, in metres; with a prior its own limits hold.
        about: a heading that is right to a few degrees; NaN: none is known.

    Returns:
        (5,) x and y of the centre, length, width and heading; and (2,) the sides that face the sensor, along
        the heading and across: -1 the lower, 1 the upper, 0 none.
    """
    known = not np.isnan(prior[0])
    most = np.full(2, longest)
    if known:
        most[0], most[1] = prior[0] + MAX_SPREAD * prior[1], prior[2] + MAX_SPREAD * prior[3]
    step = (len(points) + FEW - 1) // FEW
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
        base = WEIGHT * _closeness(u, v, seen, sides)
        if base < best:
            if known:
                many = _sizes(seen[0], seen[1], sides[0], prior[0], prior[1], along)
                wide = _sizes(seen[2], seen[3], sides[1], prior[2], prior[3], across)
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
    return box, facing


@kernel
def _extent(values: F64, most: float, out: F64) -> None:
    """Where values begin and end, strays left out; where they reach too far, the densest ``most`` of them."""
    n = len(values)
    strays = int(TRIM * n)
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
    held, end = 0, 0
    for begin in range(n):
        while end < n and ordered[end] - ordered[begin] <= most:
            end += 1
        if end - begin > held:
            held = end - begin
            out[0], out[1] = ordered[begin], ordered[end - 1]


@kernel
def _facing(low: float, high: float) -> int:
    """Which of two opposite sides faces the sensor, which is at 0: -1 the lower, 1 the upper, 0 none."""
    return -1 if low > 0 else (1 if high < 0 else 0)


@kernel
def _closeness(u: F64, v: F64, seen: F64, sides: I64) -> float:
    """Mean distance of the points from the sides that face the sensor, in NEAR_SIDE, at most STRAY."""
    total = 0.0
    for i in range(len(u)):
        if (
            u[i] < seen[0] - NEAR_SIDE
            or u[i] > seen[1] + NEAR_SIDE
            or v[i] < seen[2] - NEAR_SIDE
            or v[i] > seen[3] + NEAR_SIDE
        ):
            total += OUTSIDE * STRAY
            continue
        off = STRAY * NEAR_SIDE
        if sides[0] != 0:
            off = min(off, abs(u[i] - (seen[0] if sides[0] < 0 else seen[1])))
        if sides[1] != 0:
            off = min(off, abs(v[i] - (seen[2] if sides[1] < 0 else seen[3])))
        total += off / NEAR_SIDE
    return total / len(u)


@kernel
def _sizes(low: float, high: float, side: int, mean: float, spread: float, out: F64) -> int:
    """Beginnings, ends and costs of what may be the whole of what was seen from ``low`` to ``high``."""
    found = 0
    size = high - low
    for k in range(-2, 3):
        whole = mean + k * spread
        if whole <= size:
            if k < 2:
                continue
            whole = size
        z = (whole - mean) / spread
        hidden = whole - size
        for way in range(3 if hidden > 0 else 1):  # behind it; towards the sensor; half and half
            behind = hidden if way == 0 else (0.0 if way == 1 else hidden / 2)
            below = behind if side > 0 else hidden - behind
            towards = 0.0 if side == 0 else min((hidden - behind) / HIDDEN_SIDE, 3.0)
            out[found, 0], out[found, 1] = low - below, high + hidden - below
            out[found, 2] = 0.5 * z * z + 0.5 * towards * towards
            found += 1
    return found
