"""Voxel grid."""

from __future__ import annotations

import numpy as np

from bevviz.config import VoxelConfig
from bevviz.frame import F32, I32, Voxels
from bevviz.stages.cells import cell_keys, group
from bevviz.stages.kernel import kernel


def voxel_grid(points: F32, config: VoxelConfig) -> Voxels:
    """Keep one point for each occupied voxel.

    The grid begins half a voxel below the cloud's lowest corner, as in Open3D's ``voxel_down_sample``,
    whose points ``average`` reproduces.

    Args:
        points: (N, 3) float32 finite points.
        config: ``size`` in metres, 0 keeps every point; ``average`` takes the mean of a voxel's points,
            else its first point stands for it.

    Returns:
        Voxels in the order in which the cloud first enters them.
    """
    if config.size == 0 or len(points) == 0:
        return Voxels(points, np.arange(len(points), dtype=np.int32))
    keys, _ = cell_keys(points, config.size, shift=0.5)
    inverse, first = group(keys)
    kept = _means(points, inverse, len(first)) if config.average else points.take(first, axis=0)
    return Voxels(kept, inverse)


@kernel
def _means(points: F32, number: I32, count: int) -> F32:
    total = np.zeros((count, 3))
    size = np.zeros(count)
    for i in range(len(points)):
        size[number[i]] += 1
        for axis in range(3):
            total[number[i], axis] += points[i, axis]
    means = np.empty((count, 3), np.float32)
    for k in range(count):
        for axis in range(3):
            means[k, axis] = total[k, axis] / size[k]
    return means
