"""Voxel grid downsampling."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from bevviz.config import VoxelConfig
from bevviz.model.frame import F32, I32, I64
from bevviz.model.results import Voxels
from bevviz.stages.cells import cell_keys, group
from bevviz.support.numba_kernel import kernel

S = TypeVar("S", bound=np.generic)


def voxel_grid(points: F32, config: VoxelConfig) -> Voxels:
    """Keep one point for each occupied voxel.

    The grid begins half a voxel below the lowest corner of the cloud, as in Open3D's ``voxel_down_sample``.
    ``average`` gives the same points as that function.

    Args:
        points: (N, 3) float32 finite points.
        config: ``size`` is in metres; 0 keeps every point. With ``average`` the mean of its points stands for
            a voxel, otherwise its first point.

    Returns:
        Voxels in the order in which the cloud first enters them.
    """
    if config.size == 0 or len(points) == 0:
        return Voxels(points, np.arange(len(points), dtype=np.int32))
    keys, _ = cell_keys(points, config.size, shift=0.5)
    kept, inverse = _thin(points, keys, config.average)
    return Voxels(kept, inverse)


@kernel
def _thin(points: F32, keys: I64, average: bool) -> tuple[F32, I32]:
    """Return one point for each distinct key, and for each input point the row of its voxel."""
    number, first = group(keys)
    kept = np.empty((len(first), 3), np.float32)
    for k in range(len(first)):
        for axis in range(3):
            kept[k, axis] = points[first[k], axis]
    if average:
        total = np.zeros((len(first), 3))
        size = np.zeros(len(first))
        for i in range(len(points)):
            size[number[i]] += 1
            for axis in range(3):
                total[number[i], axis] += points[i, axis]
        for k in range(len(first)):
            for axis in range(3):
                kept[k, axis] = total[k, axis] / size[k]
    return kept, number


@kernel
def spread_to_points(values: NDArray[S], inverse: I32) -> NDArray[S]:
    """Return the (N,) values of the points, each copied from the voxel of the point."""
    result = np.empty(len(inverse), values.dtype)
    for i in range(len(inverse)):
        result[i] = values[inverse[i]]
    return result
