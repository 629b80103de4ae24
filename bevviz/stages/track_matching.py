"""Costs of tracks and boxes, their assignment, and their overlap seen from above."""

from __future__ import annotations

import math

import numpy as np

from bevviz.model.frame import F32, F64, I32, Bool
from bevviz.stages.fusion import assign
from bevviz.support.numba_kernel import kernel

SIZE_WEIGHT = 1.0  # cost of a box that is e times larger or smaller, relative to the distance of the gate
SAME_PLACE = 0.2  # least intersection over union of a long track with its box, however far the centres are


def extents(size: F32 | F64) -> F64:
    """Return the (N, 2) logarithms of the shorter and the longer side on the ground."""
    return np.asarray(np.log(np.maximum(np.sort(size[:, :2]), 0.1)), np.float64)


@kernel
def costs(
    place: F64,
    gate: F64,
    extent: F64,
    sight: F64,
    known: Bool,
    center: F32,
    measured: F64,
    whole: Bool,
    overlap: F64,
) -> F64:
    """Return the (T, K) cost of each track and box, inf beyond the squared gate without an overlap.

    ``center``, ``measured`` and ``overlap`` are (2, ...): as seen, and as completed if the box is ``whole``.
    """
    cost = np.full((len(place), len(whole)), np.inf)
    for t in range(len(place)):
        for k in range(len(whole)):
            as_whole = 1 if known[t] and whole[k] else 0
            dx, dy = place[t, 0] - center[as_whole, k, 0], place[t, 1] - center[as_whole, k, 1]
            narrower, shorter = (
                extent[t, 0] - measured[as_whole, k, 0],
                extent[t, 1] - measured[as_whole, k, 1],
            )
            if known[t] and not whole[k]:
                hidden = max(math.exp(extent[t, 1]) - math.exp(measured[0, k, 1]), 0.0) / 2
                nearer = min(max(dx * sight[t, 0] + dy * sight[t, 1], 0.0), hidden)
                dx, dy = dx - nearer * sight[t, 0], dy - nearer * sight[t, 1]
                shorter, narrower = min(shorter, 0.0), min(narrower, 0.0)
            distance = (dx * dx + dy * dy) / gate[t]
            if distance <= 1:
                size = abs(narrower) + abs(shorter)
                cost[t, k] = distance + SIZE_WEIGHT * size / 2
            shared = overlap[as_whole, t, k]
            if shared >= SAME_PLACE:
                cost[t, k] = min(cost[t, k], 2 * (1 - shared))
    return cost


def match(cost: F64) -> I32:
    """Return the (T,) box of each track, -1 for none, that minimise the sum of the costs."""
    column = np.full(len(cost), -1, np.int32)
    if cost.size == 0:
        return column
    near = np.isfinite(cost)
    near_track, near_box = near.sum(axis=1), near.sum(axis=0)
    # Most tracks have one box near, and that box has no other track. Only the others need an assignment.
    nearest = cost.argmin(1)
    alone = (near_track == 1) & (near_box[nearest] == 1)
    column[alone] = nearest[alone]
    near_box[nearest[alone]] = 0
    rows, columns = np.flatnonzero((near_track > 0) & ~alone), np.flatnonzero(near_box)
    chosen = assign(cost[np.ix_(rows, columns)], unmatched=2.0)
    column[rows] = np.where(chosen >= 0, np.append(columns, -1)[chosen], -1)
    return column
