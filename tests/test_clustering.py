"""DBSCAN equal to Open3D's on all sorts of clouds, boxes that recover rectangles, size limits that apply."""

from __future__ import annotations

import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bevviz.config import ClusteringConfig
from bevviz.extras.demo.sensors import load_open3d
from bevviz.model.frame import F32, I32, Bool
from bevviz.model.results import ClusterState
from bevviz.stages.clustering import MIN_SIZE, cluster, dbscan

# --- DBSCAN ------------------------------------------------------------------------------------


def open3d_dbscan(points: F32, eps: float, min_points: int) -> I32:
    o3d = load_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(np.float64)))
    return np.asarray(cloud.cluster_dbscan(eps, min_points), np.int32)


def neighbours(points: F32, eps: float) -> Bool:
    """(N, N) whether two points are nearer than eps: Open3D's search radius is open."""
    d = points.astype(np.float64)[:, None] - points.astype(np.float64)[None]
    near: Bool = d[..., 0] ** 2 + d[..., 1] ** 2 + d[..., 2] ** 2 < eps * eps
    return near


def assert_same_partition(a: I32, b: I32) -> None:
    """Equal up to the names of the labels."""
    pairs = np.unique(np.stack([a, b], axis=1), axis=0)
    assert len(pairs) == len(np.unique(a)) == len(np.unique(b))


def assert_equal_to_open3d(points: F32, eps: float, min_points: int) -> None:
    ours, theirs = dbscan(points, eps, min_points), open3d_dbscan(points, eps, min_points)
    near = neighbours(points, eps)
    core = near.sum(axis=1) >= min_points
    assert_same_partition(ours[core], theirs[core])
    np.testing.assert_array_equal(ours < 0, theirs < 0)
    for border in np.flatnonzero((ours >= 0) & ~core):
        assert ours[border] in ours[near[border] & core]
    appearance = ours[np.sort(np.unique(ours, return_index=True)[1])]
    np.testing.assert_array_equal(appearance[appearance >= 0], np.arange(ours.max() + 1))


@st.composite
def clouds(draw: st.DrawFn) -> F32:
    """Clumps, lines, uniform noise, lattices whose step is exactly a neighbourhood radius, duplicates."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    parts = []
    for kind in draw(
        st.lists(st.sampled_from(["clump", "line", "uniform", "lattice", "same"]), min_size=1, max_size=6)
    ):
        n = draw(st.integers(1, 60))
        place = rng.uniform(-4, 4, 3)
        if kind == "clump":
            part = place + rng.normal(0, draw(st.sampled_from([0.05, 0.3, 1.0])), (n, 3))
        elif kind == "line":
            part = place + np.linspace(0, draw(st.sampled_from([1.0, 5.0, 20.0])), n)[:, None] * rng.normal(
                size=3
            )
        elif kind == "uniform":
            part = rng.uniform(-5, 5, (n, 3))
        elif kind == "lattice":
            part = np.round(place * 2) / 2 + draw(st.sampled_from([0.25, 0.5])) * rng.integers(0, 4, (n, 3))
        else:
            part = np.repeat(place[None], n, axis=0)
        parts.append(part)
    return rng.permutation(np.concatenate(parts)).astype(np.float32)


@settings(deadline=None, max_examples=300)
@given(clouds(), st.sampled_from([0.1, 0.25, 0.3, 0.5, 1.0, 3.0]), st.sampled_from([1, 2, 3, 5, 10, 50]))
def test_dbscan_equals_open3d(points: F32, eps: float, min_points: int) -> None:
    assert_equal_to_open3d(points, eps, min_points)


def test_points_exactly_eps_apart_are_no_neighbours() -> None:
    points = np.array([[0, 0, 0], [0.5, 0, 0]], np.float32)
    np.testing.assert_array_equal(dbscan(points, 0.5, 2), [-1, -1])
    np.testing.assert_array_equal(dbscan(points, 0.5000001, 2), [0, 0])
    # 3, 4, 5: exact in the squares too.
    np.testing.assert_array_equal(dbscan(np.array([[0, 0, 0], [3, 4, 0]], np.float32), 5.0, 2), [-1, -1])


def test_border_point_goes_to_the_nearest_core_point() -> None:
    left = np.stack([np.linspace(-0.5, -0.4, 9), np.zeros(9), np.zeros(9)], axis=1)
    points = np.vstack([left, -left, [[0.004, 0, 0]]]).astype(np.float32)
    labels = dbscan(points, 0.41, 9)
    assert labels[-1] == labels[9] != labels[0]


@pytest.mark.parametrize("min_points", [10, 50])
def test_dbscan_equals_open3d_on_a_real_scan(shared_scan: F32, min_points: int) -> None:
    points = shared_scan[shared_scan[:, 2] > -1.3]
    ours, theirs = dbscan(points, 0.5, min_points), open3d_dbscan(points, 0.5, min_points)
    np.testing.assert_array_equal(ours < 0, theirs < 0)
    assert ours.max() == theirs.max()
    # All but border points between two clusters: a handful.
    size = np.bincount(ours[ours >= 0])
    agree = sum(np.bincount(theirs[ours == k]).max() for k in range(len(size)))
    assert size.sum() - agree <= 0.001 * size.sum()


@pytest.fixture(scope="module")
def shared_scan(shared: Path) -> F32:
    scan = np.fromfile(shared / "kitti" / "velodyne" / "000001.bin", np.float32)
    return np.ascontiguousarray(scan.reshape(-1, 4)[:, :3])


def hard_clouds() -> dict[str, F32]:
    rng = np.random.default_rng(0)
    n = 100_000
    two_cells = rng.uniform(0, 0.02, (n, 3))
    two_cells[n // 2 :, 0] += 0.45
    return {
        "one place": np.ones((n, 3), np.float32),
        "one cell": rng.uniform(0, 0.2, (n, 3)).astype(np.float32),
        "two cells": two_cells.astype(np.float32),
        "far apart": rng.uniform(-1e30, 1e30, (n, 3)).astype(np.float32),
        "far away": rng.uniform([4.4e6, 5.5e6, 300], [4.40002e6, 5.50002e6, 320], (n, 3)).astype(np.float32),
        "upright line": np.column_stack([np.zeros((n, 2)), rng.permutation(n)]).astype(np.float32),
        "no neighbours": (rng.permutation(n)[:, None] * np.array([[1.0, 0.5, 0.1]])).astype(np.float32),
    }


@pytest.mark.parametrize("name", hard_clouds())
def test_dense_clouds_take_no_longer(name: str) -> None:
    points = hard_clouds()[name]
    dbscan(points[:100], 0.5, 10)  # compiled
    begin = time.perf_counter()
    labels = dbscan(points, 0.5, 10)
    assert time.perf_counter() - begin < 3
    clusters = {
        "one place": 1,
        "one cell": 1,
        "two cells": 1,
        "far apart": 0,
        "upright line": 0,
        "no neighbours": 0,
    }
    if name in clusters:
        assert labels.max() + 1 == clusters[name]


def test_one_point_or_no_point_is_clustered() -> None:
    assert dbscan(np.zeros((0, 3), np.float32), 0.5, 1).shape == (0,)
    np.testing.assert_array_equal(dbscan(np.zeros((1, 3), np.float32), 0.5, 1), [0])
    np.testing.assert_array_equal(dbscan(np.zeros((1, 3), np.float32), 0.5, 2), [-1])


# --- boxes -------------------------------------------------------------------------------------


def rectangle(length: float, width: float, yaw: float, sides: int, rng: np.random.Generator) -> F32:
    """Noisy points 2 cm apart on the first sides of a rectangle 1.5 m high with its middle at (20, -7)."""
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]]) * [length / 2, width / 2]
    outline = [
        a + (b - a) * np.linspace(0, 1, max(2, int(np.linalg.norm(b - a) / 0.02)))[:, None]
        for a, b in pairwise(corners[: sides + 1])
    ]
    xy = np.concatenate(outline)
    xy = xy + rng.normal(0, 0.01, xy.shape)
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return np.column_stack([xy @ turn + [20, -7], rng.uniform(0, 1.5, len(xy))]).astype(np.float32)


def off(a: float, b: float) -> float:
    """Difference of two headings, which half a turn does not change."""
    return abs((a - b + np.pi / 2) % np.pi - np.pi / 2)


@settings(deadline=None, max_examples=100)
@given(
    st.floats(3, 12),
    st.floats(1, 2.5),
    st.floats(-np.pi, np.pi),
    st.sampled_from([2, 3, 4]),
    st.integers(0, 999),
)
def test_oriented_box_recovers_a_rectangle(
    length: float, width: float, yaw: float, sides: int, seed: int
) -> None:
    """Two sides are what a LiDAR sees of a car: the L-shape."""
    points = rectangle(length, width, yaw, sides, np.random.default_rng(seed))
    boxes = cluster(points, ClusteringConfig(eps=2)).obb
    assert len(boxes) == 1
    assert off(float(boxes.yaw[0]), yaw) < np.radians(2)
    np.testing.assert_allclose(boxes.size[0, :2], [length, width], atol=0.35)
    np.testing.assert_allclose(boxes.center[0, :2], [20, -7], atol=0.2)


@settings(deadline=None, max_examples=60)
@given(clouds())
def test_boxes_hold_their_points(points: F32) -> None:
    found = cluster(points, ClusteringConfig(min_points=2, min_cluster_points=1))
    np.testing.assert_array_equal(
        found.count, np.bincount(found.labels[found.labels >= 0], minlength=len(found))
    )
    for boxes in (found.aabb, found.obb):
        assert np.all(boxes.size >= np.float32(MIN_SIZE))
        for k in range(len(found)):
            own = points[found.labels == k] - boxes.center[k]
            c, s = np.cos(boxes.yaw[k]), np.sin(boxes.yaw[k])
            local = own @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            assert np.all(np.abs(local) <= boxes.size[k] / 2 + 1e-4)
    for k in range(len(found)):
        np.testing.assert_allclose(found.centroid[k], points[found.labels == k].mean(axis=0), atol=1e-4)
    assert np.all(found.obb.size[:, 0] >= found.obb.size[:, 1])
    assert np.all((found.obb.yaw > -np.pi / 2) & (found.obb.yaw <= np.float32(np.pi / 2)))
    assert not found.aabb.yaw.any()


def test_clusters_beyond_size_limits_are_set_aside() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal([5 * k, 0, 0], 0.1, (n, 3)) for k, n in enumerate([12, 40, 300])])
    found = cluster(
        points.astype(np.float32), ClusteringConfig(min_cluster_points=20, max_cluster_points=100)
    )
    np.testing.assert_array_equal(found.count, [12, 40, 300])
    np.testing.assert_array_equal(
        found.state, [ClusterState.TOO_SMALL, ClusterState.KEPT, ClusterState.TOO_LARGE]
    )


@pytest.mark.parametrize(
    "points", [np.zeros((0, 3), np.float32), np.array([[1, 2, 3], [40, 5, 6]], np.float32)]
)
def test_an_empty_cloud_has_no_clusters(points: F32) -> None:
    found = cluster(points, ClusteringConfig())
    assert len(found) == len(found.aabb) == len(found.obb) == 0
    np.testing.assert_array_equal(found.labels, np.full(len(points), -1))
    assert found.centroid.shape == found.obb.size.shape == (0, 3)
