"""Points in the frustum of an image box: the best candidate, and the points in the box fitted to it."""

from __future__ import annotations

import math

import numpy as np

from bevviz.model.frame import F32, F64, I32, I64
from bevviz.stages.box_fit import fit
from bevviz.support.numba_kernel import kernel

MARGIN = 0.05  # share of a box's width that is searched on either side of it
TIGHT_SHARE = 0.15  # share of a box's sides by which the box may be too tight
AROUND_SHARE = 0.5  # share of a box's width on either side in which points show that an object continues
ABOVE_SHARE = 1.0  # the same of its height above it: a post or a hedge is taller than the object in the box
STUDENT_FREEDOM = 4.0  # degrees of freedom of Student's t for the deviation of a height from its class
FOOTING = 0.2  # metres, one sigma of the ground below an object
HIDDEN_FOOT = 4.0  # sigmas: a lower edge above the ground costs no more, because the foot may be hidden
DEPTH_STEPS = 8  # a window in depth moves by its length divided by this
OWN_MARGIN = 0.1  # metres around a fitted box in which a point still belongs to it
REMAINDER_MARGIN = 0.5  # metres around a box in which the small remainder of a cluster belongs to it


@kernel
def choose_candidate(
    points: F32,
    place: F64,
    uv: F32,
    seen: I64,
    taker: I32,
    box: F64,
    gap: float,
    ratio: float,
    tall: float,
    sizes: F64,
    lowest: float,
    ground: F32,
    eye: float,
    drop: float,
    footing: float,
    fewest: int,
    least: float,
) -> tuple[I64, float, float]:
    """Choose the best candidate in the frustum of an image box, for any size of the class.

    Args:
        points: (P, 3).
        place: (2,) position of the camera.
        uv: (P, 2) pixels.
        seen: rows of the points in the image.
        taker: (P,) -1 for a free point.
        box: (4,) the image box.
        gap: metres; points this near are connected.
        ratio: size of the object for each metre of distance.
        tall: height of the object for each metre of distance.
        sizes: (M, 3) metres: largest depth of an object of each size, its height, and sigma of that height.
            NaN: the height is unknown, and the depth is at most the size.
        lowest: sigmas; a lower height costs no more than this.
        ground: (P,) z of the ground below each point, empty if it is unknown.
        eye: z of the camera.
        drop: rise of the ray through the lower edge of the image box for each metre of distance.
        footing: one sigma of the lower edge for each metre of distance, inf if the edge tells nothing.
        fewest: smallest number of points of a candidate.
        least: smallest part of the image box that a candidate covers.

    Returns:
        The rows of the candidate's points, its rating without the score, and the distance of its front.
    """
    margin, around = MARGIN * (box[2] - box[0]), AROUND_SHARE * (box[2] - box[0])
    above = ABOVE_SHARE * (box[3] - box[1])
    near = np.empty(len(seen), np.int64)
    n = 0
    for i in seen:
        near[n] = i
        beside = box[0] - around <= uv[i, 0] <= box[2] + around
        n += beside and box[1] - above <= uv[i, 1] <= box[3] and taker[i] == -1
    near = near[:n]
    inside, far = np.empty(n, np.bool_), np.empty(n)
    xy = np.empty((n, 2))
    low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
    for i in range(n):
        xy[i, 0], xy[i, 1] = points[near[i], 0] - place[0], points[near[i], 1] - place[1]
        far[i] = math.hypot(xy[i, 0], xy[i, 1])
        inside[i] = box[0] - margin <= uv[near[i], 0] <= box[2] + margin and box[1] <= uv[near[i], 1]
        if inside[i]:
            low_x, high_x = min(low_x, xy[i, 0]), max(high_x, xy[i, 0])
            low_y, high_y = min(low_y, xy[i, 1]), max(high_y, xy[i, 1])
    if high_x < low_x:
        return near[:0], 0.0, 0.0

    # Find connected points: cells half as wide as the gap are flooded two cells far. -1 waits, -2 is empty.
    cell = gap / 2
    columns, rows = int((high_x - low_x) / cell) + 1, int((high_y - low_y) / cell) + 1
    grid = np.full((columns, rows), -2, np.int32)
    at = np.empty((n, 2), np.int64)
    for i in range(n):
        at[i, 0], at[i, 1] = (math.floor((xy[i, 0] - low_x) / cell), math.floor((xy[i, 1] - low_y) / cell))
        if inside[i]:
            grid[at[i, 0], at[i, 1]] = -1
    stack = np.empty((n, 2), np.int64)
    bodies = 0
    for i in range(n):
        if not inside[i] or grid[at[i, 0], at[i, 1]] != -1:
            continue
        grid[at[i, 0], at[i, 1]] = bodies
        stack[0, 0], stack[0, 1] = at[i, 0], at[i, 1]
        top = 1
        while top:
            top -= 1
            column, row = stack[top, 0], stack[top, 1]
            for p in range(max(column - 2, 0), min(column + 3, columns)):
                for q in range(max(row - 2, 0), min(row + 3, rows)):
                    if grid[p, q] == -1:
                        grid[p, q] = bodies
                        stack[top, 0], stack[top, 1] = p, q
                        top += 1
        bodies += 1
    start = np.zeros(bodies + 1, np.int64)
    body = np.full(n, -1, np.int64)
    for i in range(n):
        if inside[i]:
            body[i] = grid[at[i, 0], at[i, 1]]
        for p in range(max(at[i, 0] - 2, 0), 0 if inside[i] else min(at[i, 0] + 3, columns)):
            for q in range(max(at[i, 1] - 2, 0), min(at[i, 1] + 3, rows)):
                if grid[p, q] >= 0 and (body[i] < 0 or (p == at[i, 0] and q == at[i, 1])):
                    body[i] = grid[p, q]
        if body[i] >= 0:
            start[body[i] + 1] += 1
    for k in range(bodies):
        start[k + 1] += start[k]
    end, by_body = start[:-1].copy(), np.empty(start[-1], np.int64)
    for i in np.argsort(far):
        if body[i] >= 0:
            by_body[end[body[i]]] = i
            end[body[i]] += 1

    area = (box[2] - box[0]) * (box[3] - box[1])
    best, best_first, best_last, best_far = 0.0, 0, 0, 0.0
    for reach, height, sigma in sizes:
        for k in range(bodies):
            first = start[k]
            while first < start[k + 1]:
                begin = far[by_body[first]]
                deep = ratio * begin if np.isnan(reach) else reach
                u0, v0, u1, v1 = np.inf, np.inf, -np.inf, -np.inf
                count = 0
                below = 0.0
                last = first
                while last < start[k + 1] and far[by_body[last]] <= begin + deep:
                    i = by_body[last]
                    if inside[i]:
                        count += 1
                        below += ground[near[i]] if len(ground) else 0.0
                        u, v = uv[near[i], 0], uv[near[i], 1]
                        u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
                    last += 1
                if count >= fewest:
                    covered = max(min(u1, box[2]) - max(u0, box[0]), 0.0) * max(
                        min(v1, box[3]) - max(v0, box[1]), 0.0
                    )
                    overlap = covered / area if area > 0 else 0.0
                    front = far[by_body[first + (last - 1 - first) // DEPTH_STEPS]]
                    rating = overlap * count / (last - first)
                    if not np.isnan(height):
                        z = max((tall * front - height) / sigma, -lowest)
                        rating /= 1 + z * z / STUDENT_FREEDOM
                    if len(ground) and footing < np.inf:
                        z = (eye + drop * front - below / count) / math.hypot(FOOTING, footing * front)
                        rating /= 1 + min(z * z, HIDDEN_FOOT**2) / STUDENT_FREEDOM
                    if overlap >= least and rating > best:
                        best, best_first, best_last, best_far = rating, first, last, front
                if last == start[k + 1]:
                    break
                while first < start[k + 1] and far[by_body[first]] < begin + deep / DEPTH_STEPS:
                    first += 1
    chosen = by_body[best_first:best_last]
    return near[chosen[inside[chosen]]], best, best_far


@kernel
def fit_from(
    points: F32,
    rows: I64,
    place: F64,
    normals: F64,
    edge: F64,
    sizes: F64,
    bounds: F64,
    longest: float,
    about: float,
) -> tuple[F64, I64, int]:
    """Fit a box with ``box_fit.fit`` to points seen from a place."""
    xy = np.empty((len(rows), 2))
    for k, i in enumerate(rows):
        xy[k, 0], xy[k, 1] = points[i, 0] - place[0], points[i, 1] - place[1]
    flat, facing, number = fit(xy, normals, edge, sizes, bounds, longest, about)
    flat[0] += place[0]
    flat[1] += place[1]
    return flat, facing, number


@kernel
def _within(points: F32, i: int, flat: F64, skin: float) -> bool:
    """Return whether a point is within ``skin`` of a box seen from above (centre, length, width, heading)."""
    c, s = math.cos(flat[4]), math.sin(flat[4])
    x, y = points[i, 0] - flat[0], points[i, 1] - flat[1]
    along, across = abs(c * x + s * y), abs(c * y - s * x)
    return bool(along <= flat[2] / 2 + skin and across <= flat[3] / 2 + skin)


@kernel
def share_inside(points: F32, rows: I64, flat: F64) -> float:
    """Return the share of these points that a box seen from above holds."""
    n = 0
    for i in rows:
        n += _within(points, i, flat, OWN_MARGIN)
    return n / len(rows)


@kernel
def points_inside(
    points: F32,
    uv: F32,
    seen: I64,
    kin: I64,
    taker: I32,
    owner: I64,
    box: F64,
    flat: F64,
    tight: float,
    unseen: bool,
) -> I64:
    """Return the free points in an object's box.

    The points are those in the image box, and those of the object's clusters beside it.

    Args:
        points: (P, 3).
        uv: (P, 2) pixels of the points.
        seen: rows of the points in the image.
        kin: rows of the points of the object's clusters.
        taker: (P,) -1 for a point that no detection of this camera has.
        owner: (P,) -1 for a point that no detection of any camera has.
        box: (4,) image box.
        flat: (5,) centre, length, width and heading of the object's box.
        tight: share of the image box's width by which it may be too tight for its clusters.
        unseen: whether points of its clusters outside the image count, too.
    """
    margin, across = MARGIN * (box[2] - box[0]), tight * (box[2] - box[0])
    along = TIGHT_SHARE * (box[3] - box[1])
    inside = np.empty(len(seen) + len(kin), np.int64)
    known = np.zeros(len(points), np.bool_)
    n = 0
    for i in seen:
        if (
            box[0] - margin <= uv[i, 0] <= box[2] + margin
            and box[1] <= uv[i, 1] <= box[3]
            and taker[i] == -1
            and owner[i] == -1
            and _within(points, i, flat, OWN_MARGIN)
        ):
            inside[n] = i
            known[i] = True
            n += 1
    for i in kin:
        if known[i] or taker[i] != -1 or owner[i] != -1:
            continue
        beside = (
            box[0] - across <= uv[i, 0] <= box[2] + across and box[1] - along <= uv[i, 1] <= box[3] + along
        )
        if (beside or (unseen and np.isnan(uv[i, 0]))) and _within(points, i, flat, OWN_MARGIN):
            inside[n] = i
            n += 1
    return inside[:n]


@kernel
def cluster_remainder(points: F32, cluster_rows: I64, rows: I64, flat: F64, smallest: int) -> I64:
    """Return the remainder of a cluster, or nothing.

    It is returned if it is beside the object and too small for a cluster of its own.
    """
    is_claimed = np.zeros(len(points), np.bool_)
    for i in rows:
        is_claimed[i] = True
    rest = np.empty(len(cluster_rows), np.int64)
    n = 0
    for i in cluster_rows:
        if not is_claimed[i]:
            if n + 1 >= smallest or not _within(points, i, flat, REMAINDER_MARGIN):
                return rest[:0]
            rest[n] = i
            n += 1
    return rest[:n]
