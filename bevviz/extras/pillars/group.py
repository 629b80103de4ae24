"""Group points into pillars and compute the features of each point (Lang et al. 2019, PointPillars)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bevviz.extras.pillars.params import Feature
from bevviz.model.frame import F32, F64, I32
from bevviz.support.numba_kernel import kernel


@dataclass(frozen=True, slots=True, eq=False)
class Pillars:
    """Pillars in the order of their first points: P pillars with at most M points each.

    Attributes:
        points: (P, M, F) float32 features of the points, zeros after the last point.
        counts: (P,) int32 points in each pillar.
        cells: (P, 2) int32 cell of each pillar along x and y.
        left_out_points: number of points dropped because their pillar was full.
        left_out_pillars: number of pillars dropped because the maximum was reached.
    """

    points: F32
    counts: I32
    cells: I32
    left_out_points: int
    left_out_pillars: int

    def __len__(self) -> int:
        return len(self.counts)


def group(
    points: F32,
    low: Sequence[float],
    size: Sequence[float],
    shape: tuple[int, int],
    high_z: float,
    max_points: int,
    max_pillars: int,
    features: Sequence[Feature],
    intensity: F32 | None = None,
) -> Pillars:
    """Group points as mmcv's and spconv's hard voxelization does: first come, first served.

    Args:
        points: (N, 3) float32 finite points. Points outside the range are in no pillar.
        low: lowest x, y, z of the range, in metres.
        size: edges of a pillar in metres.
        shape: number of pillars along x and y.
        high_z: metres, exclusive end of the range in z.
        max_points: largest number of points in a pillar.
        max_pillars: largest number of pillars.
        features: features in the order of the network's input.
        intensity: (N,) of the points; None: 0.
    """
    start, edge = np.asarray(low, np.float32), np.asarray(size, np.float32)
    place, slot, counts, cells, full, more = _assign_pillars(
        points, start, edge, shape[0], shape[1], np.float32(high_z), max_points, max_pillars
    )
    kept = np.flatnonzero(place >= 0)
    place, slot, xyz = place[kept], slot[kept], points[kept]
    values = np.empty((len(kept), len(features)), np.float32)
    mean: F64 | None = None
    center: F32 | None = None
    for k, feature in enumerate(features):
        axis = "xyz".find(feature[-1])
        if feature in ("x", "y", "z"):
            values[:, k] = xyz[:, axis]
        elif feature == "intensity":
            values[:, k] = 0 if intensity is None else intensity[kept]
        elif feature == "time":
            values[:, k] = 0
        elif feature == "distance":
            values[:, k] = np.sqrt((xyz**2).sum(axis=1))
        elif feature.startswith("mean"):
            mean = _means(xyz, place, counts) if mean is None else mean
            values[:, k] = xyz[:, axis] - mean[place, axis].astype(np.float32)
        else:
            if center is None:
                center = np.zeros((len(counts), 3), np.float32)
                center[:, :2] = cells
                center *= edge
                center += edge / 2 + start
            values[:, k] = xyz[:, axis] - center[place, axis]
    shown = np.zeros((len(counts), max_points, len(features)), np.float32)
    shown[place, slot] = values
    return Pillars(shown, counts, cells, int(full), int(more))


def scatter(features: F32, cells: I32, shape: tuple[int, int]) -> F32:
    """Return the (P, C) features of pillars as a (1, C, ny, nx) map, zeros in empty cells."""
    nx, ny = shape
    canvas = np.zeros((features.shape[1], ny * nx), np.float32)
    canvas[:, cells[:, 1].astype(np.int64) * nx + cells[:, 0]] = features.T
    return canvas.reshape(1, -1, ny, nx)


def _means(points: F32, place: I32, counts: I32) -> F64:
    """Return the (P, 3) mean of each pillar's points."""
    sums = [np.bincount(place, points[:, axis], len(counts)) for axis in range(3)]
    return np.column_stack(sums) / np.maximum(counts, 1)[:, None]


@kernel
def _assign_pillars(
    points: F32, low: F32, size: F32, nx: int, ny: int, high_z: np.float32, max_points: int, max_pillars: int
) -> tuple[I32, I32, I32, I32, int, int]:
    """Assign each point to a pillar and a slot in it.

    Returns:
        Pillar of each point, -1 for none.
        Slot of each point in its pillar.
        Number of points of each pillar.
        Cell of each pillar.
        Number of points dropped from full pillars.
        Number of pillars dropped.
    """
    n = len(points)
    number = np.full(nx * ny, -1, np.int32)
    place = np.full(n, -1, np.int32)
    slot = np.zeros(n, np.int32)
    counts = np.zeros(min(max_pillars, n), np.int32)
    cells = np.empty((len(counts), 2), np.int32)
    pillars, full, more = 0, 0, 0
    for i in range(n):
        x = np.floor((points[i, 0] - low[0]) / size[0])
        y = np.floor((points[i, 1] - low[1]) / size[1])
        z = points[i, 2]
        if not (x >= 0 and x < nx and y >= 0 and y < ny and z >= low[2] and z < high_z):
            continue
        cell = np.int64(y) * nx + np.int64(x)
        k = number[cell]
        if k == -1:
            if pillars == max_pillars:
                number[cell] = -2
                more += 1
                continue
            k = np.int32(pillars)
            number[cell] = k
            cells[k, 0], cells[k, 1] = np.int32(x), np.int32(y)
            pillars += 1
        if k < 0:
            continue
        if counts[k] == max_points:
            full += 1
            continue
        place[i], slot[i] = k, counts[k]
        counts[k] += 1
    return place, slot, counts[:pillars], cells[:pillars], full, more
