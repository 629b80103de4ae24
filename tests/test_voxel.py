"""Voxel grid: equal to Open3D's, and a true partition of the cloud."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bevviz.config import VoxelConfig
from bevviz.extras.demo.sensors import load_open3d
from bevviz.model.frame import F32
from bevviz.stages.voxel import voxel_grid

clouds = hnp.arrays(
    np.float32, st.tuples(st.integers(1, 200), st.just(3)), elements=st.floats(-20, 20, width=32)
)


def assert_equal_to_open3d(points: F32, size: float, tolerance: float) -> None:
    """As many points, and each of either side at one of the other."""
    o3d = load_open3d()

    def cloud(xyz: F32) -> Any:
        return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(xyz.astype(np.float64)))

    ours = cloud(voxel_grid(points, VoxelConfig(size=size, average=True)).points)
    theirs = cloud(points).voxel_down_sample(size)
    assert len(ours.points) == len(theirs.points)
    assert np.max(ours.compute_point_cloud_distance(theirs)) <= tolerance
    assert np.max(theirs.compute_point_cloud_distance(ours)) <= tolerance


@pytest.mark.parametrize("frame", ["000000", "000001"])
def test_averages_equal_open3d_on_a_real_scan(shared: Path, frame: str) -> None:
    scan = np.fromfile(shared / "kitti" / "velodyne" / f"{frame}.bin", np.float32).reshape(-1, 4)
    assert_equal_to_open3d(np.ascontiguousarray(scan[:, :3]), 0.05, 1e-5)


@settings(deadline=None, max_examples=60)
@given(clouds, st.sampled_from([0.05, 0.3, 1.0, 7.0]))
def test_averages_equal_open3d(points: F32, size: float) -> None:
    assert_equal_to_open3d(points, size, 5e-6)


def test_averages_equal_open3d_where_indices_exceed_64_bits() -> None:
    clump = np.random.default_rng(1).uniform(-2, 2, (500, 3))
    corners = np.array([[0, 0, 0], [1e6, 1e6, 1e6], [-1e6, 1e6, -1e6], [-1e6, -1e6, 3e6]])
    points = (corners[:, None] + clump).reshape(-1, 3).astype(np.float32)
    assert_equal_to_open3d(points, 0.1, 0.2)  # float32 has steps of 0.25 m at 3e6 m


@settings(deadline=None, max_examples=60)
@given(clouds, st.sampled_from([0.05, 0.3, 1.0, 7.0]))
def test_the_first_point_of_each_voxel_is_kept_in_order(points: F32, size: float) -> None:
    voxels = voxel_grid(points, VoxelConfig(size=size))
    _, first = np.unique(voxels.inverse, return_index=True)
    assert np.all(np.diff(first) > 0)
    np.testing.assert_array_equal(voxels.points, points[first])
    assert np.all(np.abs(points - voxels.points[voxels.inverse]) <= size * (1 + 1e-5))


def test_inverse_names_the_averaged_points() -> None:
    points = np.random.default_rng(0).normal(size=(5000, 3)).astype(np.float32)
    voxels = voxel_grid(points, VoxelConfig(size=0.5, average=True))
    for k in (0, 1, len(voxels.points) - 1):
        np.testing.assert_allclose(voxels.points[k], points[voxels.inverse == k].mean(axis=0), atol=1e-5)


@pytest.mark.parametrize("points", [np.zeros((0, 3), np.float32), np.ones((3, 3), np.float32)])
def test_size_zero_keeps_the_points_untouched(points: F32) -> None:
    voxels = voxel_grid(points, VoxelConfig(size=0))
    assert voxels.points is points
    np.testing.assert_array_equal(voxels.inverse, np.arange(len(points)))


def test_an_empty_cloud_stays_empty() -> None:
    voxels = voxel_grid(np.zeros((0, 3), np.float32), VoxelConfig(size=0.1))
    assert voxels.points.shape == (0, 3)
    assert voxels.inverse.shape == (0,)


def test_points_at_the_limits_of_float32_are_averaged() -> None:
    points = np.array([[3e38, 0, 0], [-3e38, 0, 0], [0, 1e-30, 0], [0, 0, 0]], np.float32)
    np.testing.assert_array_equal(voxel_grid(points, VoxelConfig(size=0.1)).inverse, [0, 1, 2, 2])
