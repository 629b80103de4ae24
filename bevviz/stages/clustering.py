"""DBSCAN on a grid, and the boxes of its clusters."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bevviz.config import ClusteringConfig
from bevviz.model.frame import F32, F64, I32, I64, Boxes3D
from bevviz.model.results import Clusters, ClusterState
from bevviz.stages.cells import cell_keys, sort_by, sort_by_key
from bevviz.support.numba_kernel import kernel, unordered_kernel

MIN_SIZE = 0.01  # metres: no side of a box is shorter, so that each box has a volume and can be drawn and hit


def cluster(points: F32, config: ClusteringConfig) -> Clusters:
    """Cluster the obstacle points with DBSCAN. Compute the size verdict and the boxes of each cluster.

    Args:
        points: (P, 3) float32 finite points.
        config: the parameters of DBSCAN and the size limits.

    Returns:
        Clusters in the order of their first points. Clusters outside the size limits are included, with
        their state. The oriented boxes have size x >= size y and yaw in (-pi/2, pi/2]. No side of a box is
        shorter than ``MIN_SIZE``.
    """
    return describe_clusters(points, dbscan(points, config.eps, config.min_points), config)


def describe_clusters(points: F32, labels: I32, config: ClusteringConfig) -> Clusters:
    """Compute counts, size verdicts and boxes of clusters of any method.

    Args:
        points: (P, 3) float32 finite points.
        labels: (P,) int32. -1 is noise; every number from 0 to the largest is the label of a point.
        config: the size limits.
    """
    order, start = sort_by(labels + np.int32(1), int(labels.max()) + 2 if len(labels) else 1)
    start = start[1:]  # the first group is noise
    count = start[1:] - start[:-1]
    centroid, oriented = np.empty((len(count), 3), np.float32), np.empty((len(count), 7), np.float32)
    low, high = np.empty_like(centroid), np.empty_like(centroid)
    _fill_boxes(points, order, start, centroid, low, high, oriented)
    state = np.full(len(count), ClusterState.KEPT, np.int32)
    state[count < config.min_cluster_points] = ClusterState.TOO_SMALL
    if config.max_cluster_points is not None:
        state[count > config.max_cluster_points] = ClusterState.TOO_LARGE
    aligned = Boxes3D(
        np.float32(0.5) * (low + high), np.maximum(high - low, MIN_SIZE), np.zeros(len(count), np.float32)
    )
    return Clusters(labels, state, count, centroid, aligned, _upright(oriented))


def update_clusters(
    points: F32, labels: I32, before: Clusters, kept_rows: I64, named: I32, config: ClusteringConfig
) -> Clusters:
    """Describe clusters as ``describe_clusters`` does, and reuse the values of unchanged clusters.

    Args:
        points: (P, 3) float32 finite points.
        labels: (P,) int32, as in ``describe_clusters``.
        before: the clusters before the change.
        kept_rows: (K,) row in ``before`` of each unchanged cluster, -1 for the others.
        named: rows of clusters that are kept, regardless of the size limits.
        config: the size limits.
    """
    fresh = np.flatnonzero(kept_rows < 0)
    number = np.full(len(kept_rows) + 1, -1, np.int32)
    number[fresh] = np.arange(len(fresh), dtype=np.int32)
    touched = np.flatnonzero(number[labels] >= 0)
    new = describe_clusters(points[touched], number[labels[touched]], config)
    old = np.flatnonzero(kept_rows >= 0)
    row = np.empty(len(kept_rows), np.int64)
    row[old], row[fresh] = np.arange(len(old)), len(old) + np.arange(len(fresh))

    def joined(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate([a[kept_rows[old]], b])[row]

    def boxes(a: Boxes3D, b: Boxes3D) -> Boxes3D:
        return Boxes3D(joined(a.center, b.center), joined(a.size, b.size), joined(a.yaw, b.yaw))

    state = joined(before.state, new.state)
    state[named] = ClusterState.KEPT
    count, centroid = joined(before.count, new.count), joined(before.centroid, new.centroid)
    return Clusters(labels, state, count, centroid, boxes(before.aabb, new.aabb), boxes(before.obb, new.obb))


def dbscan(points: F32, eps: float, min_points: int) -> I32:
    """Compute exact DBSCAN clustering (Ester et al. 1996) on a grid.

    Points are binned in cells whose diagonal is shorter than ``eps`` (Gunawan 2013). A cell with
    ``min_points`` points has only core points. The core points of a cell belong together; no distance is
    measured. Union-find then joins the cells. Distances are compared in double precision and strictly, as
    Open3D does: two points exactly ``eps`` apart are not neighbours.

    Args:
        points: (N, 3) float32 finite points.
        eps: radius of the neighbourhood in metres.
        min_points: neighbours that make a core point, including the point itself.

    Returns:
        (N,) int32 labels, numbered in the order of each cluster's first point. Noise has the label -1. A
        border point gets the cluster of its nearest core point.
    """
    if len(points) == 0:
        return np.zeros(0, np.int32)
    # The factor keeps the diagonal below eps, so that rounding never puts points eps apart into one cell.
    keys, strides = cell_keys(points, eps / math.sqrt(3) * (1 - 1e-6), reach=2)
    return _dbscan(points, keys, np.sort(strides)[::-1], eps * eps, min_points)


# --- DBSCAN ------------------------------------------------------------------------------------
# Points are sorted by cell. The points of cell c are start[c]:start[c + 1], core points first. The cells
# that may hold neighbours of these points are neighbours[near[c]:near[c + 1]].


@kernel
def _dbscan(points: F32, keys: I64, strides: I64, eps2: float, min_points: int) -> I32:
    order, start = sort_by_key(keys)
    x, y, z = np.empty_like(points[:, 0]), np.empty_like(points[:, 1]), np.empty_like(points[:, 2])
    for i in range(len(order)):
        x[i], y[i], z[i] = points[order[i]]
    box = _cell_boxes(x, y, z, start)
    near, neighbours = _adjacent(keys[order[start[:-1]]], strides, box, eps2)
    cores = _core_points(x, y, z, order, start, box, near, neighbours, eps2, min_points)
    parent = _join(x, y, z, start, cores, box, near, neighbours, eps2)
    return _label(x, y, z, order, start, cores, parent, near, neighbours, eps2)


@kernel
def _cell_boxes(x: F32, y: F32, z: F32, start: I32) -> F64:
    """Return (C, 6) lowest and highest x, y, z of the points of each cell."""
    box = np.empty((len(start) - 1, 6))
    for c in range(len(box)):
        for axis in range(3):
            box[c, axis], box[c, 3 + axis] = np.inf, -np.inf
        for i in range(start[c], start[c + 1]):
            box[c, 0], box[c, 3] = min(box[c, 0], x[i]), max(box[c, 3], x[i])
            box[c, 1], box[c, 4] = min(box[c, 1], y[i]), max(box[c, 4], y[i])
            box[c, 2], box[c, 5] = min(box[c, 2], z[i]), max(box[c, 5], z[i])
    return box


@kernel
def _gap(low: float, high: float, other_low: float, other_high: float) -> float:
    """Return the distance between two intervals, 0 if they overlap."""
    return max(low - other_high, other_low - high, 0.0)


@kernel
def _adjacent(keys: I64, strides: I64, box: F64, eps2: float) -> tuple[I32, I32]:
    """List the other cells whose points may be nearer than eps, as (C + 1,) starts into one list.

    Cells come sorted by key. The neighbours of a cell lie in five rows, one for each offset along the
    slowest axis. Each row is a range of keys that moves forward with the cell, so no search is needed.
    Only cells later in that order are examined: the neighbour relation is symmetric.
    """
    cells = len(keys)
    reach = 2 * strides[1] + 2
    begin = np.zeros(3, np.int64)
    near = np.zeros(cells + 1, np.int32)
    pairs = np.empty(8 * cells, np.int32)  # the neighbours of cell c end at last[c]
    last = np.empty(cells, np.int32)
    used = 0
    for c in range(cells):
        for row in range(3):
            middle = keys[c] + row * strides[0]
            o = max(begin[row], c + 1)
            while o < cells and keys[o] < middle - reach:
                o += 1
            begin[row] = o
            while o < cells and keys[o] <= middle + reach:
                if used == len(pairs):
                    longer = np.empty(2 * used, np.int32)
                    for k in range(used):
                        longer[k] = pairs[k]
                    pairs = longer
                dx = _gap(box[c, 0], box[c, 3], box[o, 0], box[o, 3])
                dy = _gap(box[c, 1], box[c, 4], box[o, 1], box[o, 4])
                dz = _gap(box[c, 2], box[c, 5], box[o, 2], box[o, 5])
                # The value is always written and sometimes kept. There is no branch to mispredict.
                pairs[used] = o
                used += dx * dx + dy * dy + dz * dz < eps2
                o += 1
        last[c] = used
    k = 0
    for c in range(cells):
        while k < last[c]:
            near[c + 1] += 1
            near[pairs[k] + 1] += 1
            k += 1
    for c in range(cells):
        near[c + 1] += near[c]
    end, neighbours = near[:-1].copy(), np.empty(2 * used, np.int32)
    k = 0
    for c in range(cells):
        while k < last[c]:
            o = pairs[k]
            neighbours[end[c]], neighbours[end[o]] = o, c
            end[c] += 1
            end[o] += 1
            k += 1
    return near, neighbours


@kernel
def _core_points(
    x: F32,
    y: F32,
    z: F32,
    order: I32,
    start: I32,
    box: F64,
    near: I32,
    neighbours: I32,
    eps2: float,
    min_points: int,
) -> I32:
    """Return the number of core points of each cell. Move them to the front of their cell, in every array."""
    cells = len(start) - 1
    cores, most = np.zeros(cells, np.int32), 0
    for c in range(cells):
        most = max(most, near[c + 1] - near[c])
    unsure = np.empty(most, np.int32)
    for c in range(cells):
        size = start[c + 1] - start[c]
        if size >= min_points:
            cores[c] = size
            continue
        # Neighbours that lie within eps as a whole count without a distance.
        sure, rest, more = size, 0, 0
        for k in range(near[c], near[c + 1]):
            o = neighbours[k]
            dx = max(box[c, 3] - box[o, 0], box[o, 3] - box[c, 0])
            dy = max(box[c, 4] - box[o, 1], box[o, 4] - box[c, 1])
            dz = max(box[c, 5] - box[o, 2], box[o, 5] - box[c, 2])
            is_near = dx * dx + dy * dy + dz * dz < eps2
            sure += is_near * (start[o + 1] - start[o])
            more += (not is_near) * (start[o + 1] - start[o])
            unsure[rest] = o
            rest += not is_near
        if sure >= min_points:
            cores[c] = size
            continue
        if sure + more < min_points:
            continue
        for i in range(start[c], start[c + 1]):
            px, py, pz = np.float64(x[i]), np.float64(y[i]), np.float64(z[i])
            count = sure
            for k in range(rest):
                o = unsure[k]
                for j in range(start[o], start[o + 1]):
                    dx, dy, dz = px - x[j], py - y[j], pz - z[j]
                    count += dx * dx + dy * dy + dz * dz < eps2
                if count >= min_points:
                    break
            if count >= min_points:
                j = start[c] + cores[c]
                x[i], x[j] = x[j], x[i]
                y[i], y[j] = y[j], y[i]
                z[i], z[j] = z[j], z[i]
                order[i], order[j] = order[j], order[i]
                cores[c] += 1
    return cores


@kernel
def _root(parent: I32, c: int) -> int:
    """Return the root of a cell's tree, and shorten the path to it."""
    while parent[c] != c:
        parent[c] = parent[parent[c]]
        c = parent[c]
    return c


@kernel
def _join(
    x: F32, y: F32, z: F32, start: I32, cores: I32, box: F64, near: I32, neighbours: I32, eps2: float
) -> I32:
    """Join cells with core points nearer than eps by union-find. Return the parent of each cell."""
    parent = np.arange(len(cores)).astype(np.int32)
    for c in range(len(cores)):
        for k in range(near[c], near[c + 1]):
            o = neighbours[k]
            if o < c or cores[c] == 0 or cores[o] == 0:
                continue
            a, b = _root(parent, c), _root(parent, o)
            if a == b:
                continue
            touch = False
            for i in range(start[c], start[c] + cores[c]):
                px, py, pz = np.float64(x[i]), np.float64(y[i]), np.float64(z[i])
                dx = _gap(px, px, box[o, 0], box[o, 3])
                dy = _gap(py, py, box[o, 1], box[o, 4])
                dz = _gap(pz, pz, box[o, 2], box[o, 5])
                if dx * dx + dy * dy + dz * dz >= eps2:
                    continue
                for j in range(start[o], start[o] + cores[o]):
                    dx, dy, dz = px - x[j], py - y[j], pz - z[j]
                    if dx * dx + dy * dy + dz * dz < eps2:
                        touch = True
                        break
                if touch:
                    parent[b] = a
                    break
    return parent


@kernel
def _label(
    x: F32,
    y: F32,
    z: F32,
    order: I32,
    start: I32,
    cores: I32,
    parent: I32,
    near: I32,
    neighbours: I32,
    eps2: float,
) -> I32:
    """Return the (N,) labels of the points in the order of the cloud."""
    root = np.full(len(order), -1, np.int32)  # for each point, in the order of the cloud
    for c in range(len(cores)):
        for i in range(start[c], start[c + 1]):
            if i < start[c] + cores[c]:
                root[order[i]] = _root(parent, c)
                continue
            px, py, pz = np.float64(x[i]), np.float64(y[i]), np.float64(z[i])
            nearest = eps2
            for k in range(near[c] - 1, near[c + 1]):
                o = c if k < near[c] else neighbours[k]
                for j in range(start[o], start[o] + cores[o]):
                    dx, dy, dz = px - x[j], py - y[j], pz - z[j]
                    d2 = dx * dx + dy * dy + dz * dz
                    if d2 < nearest:
                        nearest = d2
                        root[order[i]] = _root(parent, o)
    number = np.full(len(cores), -1, np.int32)
    count = 0
    for i in range(len(root)):
        if root[i] >= 0:
            if number[root[i]] < 0:
                number[root[i]] = count
                count += 1
            root[i] = number[root[i]]
    return root


# --- boxes -------------------------------------------------------------------------------------


def _upright(oriented: F32) -> Boxes3D:
    """Make boxes from rows of centre, size and yaw in [0, pi/2). Turn the longer side to x."""
    size, yaw = np.maximum(oriented[:, 3:6], np.float32(MIN_SIZE)), oriented[:, 6].copy()
    wide = size[:, 1] > size[:, 0]
    size[wide, :2] = size[wide, 1::-1]
    yaw[wide] -= np.float32(np.pi / 2)
    # -pi/2 and pi/2 describe the same box. The interval is open below.
    yaw[yaw <= -np.float32(np.pi / 2)] += np.float32(np.pi)
    return Boxes3D(oriented[:, :3], size, yaw)


@unordered_kernel
def _closeness(x: F64, y: F64, angle: float) -> float:
    """Return Zhang's closeness: how near the points are to the sides of the tightest rectangle."""
    c, s = math.cos(angle), math.sin(angle)
    low_u = low_v = np.inf
    high_u = high_v = -np.inf
    for i in range(len(x)):
        u, v = c * x[i] + s * y[i], c * y[i] - s * x[i]
        low_u, high_u = min(low_u, u), max(high_u, u)
        low_v, high_v = min(low_v, v), max(high_v, v)
    # The sensor saw the side of each opposite pair that the points lie along.
    far_low_u = far_high_u = far_low_v = far_high_v = 0.0
    for i in range(len(x)):
        u, v = c * x[i] + s * y[i], c * y[i] - s * x[i]
        far_low_u += (u - low_u) ** 2
        far_high_u += (high_u - u) ** 2
        far_low_v += (v - low_v) ** 2
        far_high_v += (high_v - v) ** 2
    score = 0.0
    for i in range(len(x)):
        u, v = c * x[i] + s * y[i], c * y[i] - s * x[i]
        du = u - low_u if far_low_u < far_high_u else high_u - u
        dv = v - low_v if far_low_v < far_high_v else high_v - v
        score += 1 / max(min(du, dv), 0.01)
    return score


@kernel
def _heading(x: F64, y: F64) -> float:
    """Return the angle in [0, pi/2) of the best rectangle: every 3 degrees, then every 0.25 near the best."""
    best, heading = -1.0, 0.0
    for k in range(30):
        angle = math.radians(3.0 * k)
        score = _closeness(x, y, angle)
        if score > best:
            best, heading = score, angle
    coarse = heading
    for k in range(-11, 12):
        angle = coarse + math.radians(0.25 * k)
        score = _closeness(x, y, angle)
        if score > best:
            best, heading = score, angle
    return heading % (math.pi / 2)


@kernel
def _fill_boxes(
    points: F32, order: I32, start: I32, centroid: F32, low: F32, high: F32, oriented: F32
) -> None:
    """Write centroid, lowest and highest corner, and oriented box of each cluster into the last four arrays.

    An oriented box is centre, size and yaw. L-shape fitting with the closeness criterion (Zhang et al. 2017)
    gives the heading, from at most about 256 evenly spread points of a cluster. All points give the extent.
    """
    mean = np.empty(3)
    for k in range(len(centroid)):
        count = start[k + 1] - start[k]
        for axis in range(3):
            mean[axis], low[k, axis], high[k, axis] = 0.0, np.inf, -np.inf
        for i in range(start[k], start[k + 1]):
            for axis in range(3):
                value = points[order[i], axis]
                mean[axis] += value / count
                low[k, axis], high[k, axis] = min(low[k, axis], value), max(high[k, axis], value)
        step = (count + 255) // 256
        x, y = np.empty((count + step - 1) // step), np.empty((count + step - 1) // step)
        for i in range(len(x)):
            # Coordinates relative to the mean keep their precision far from the origin.
            x[i] = points[order[start[k] + i * step], 0] - mean[0]
            y[i] = points[order[start[k] + i * step], 1] - mean[1]
        yaw = _heading(x, y)
        c, s = math.cos(yaw), math.sin(yaw)
        low_u = low_v = np.inf
        high_u = high_v = -np.inf
        for i in range(start[k], start[k + 1]):
            dx, dy = points[order[i], 0] - mean[0], points[order[i], 1] - mean[1]
            u, v = c * dx + s * dy, c * dy - s * dx
            low_u, high_u = min(low_u, u), max(high_u, u)
            low_v, high_v = min(low_v, v), max(high_v, v)
        u, v = (low_u + high_u) / 2, (low_v + high_v) / 2
        for axis in range(3):
            centroid[k, axis] = mean[axis]
        oriented[k, 0] = mean[0] + c * u - s * v
        oriented[k, 1] = mean[1] + s * u + c * v
        oriented[k, 2] = (low[k, 2] + high[k, 2]) / 2
        oriented[k, 3], oriented[k, 4], oriented[k, 5] = (
            high_u - low_u,
            high_v - low_v,
            high[k, 2] - low[k, 2],
        )
        oriented[k, 6] = yaw
