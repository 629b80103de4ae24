"""Voxel grid."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from bevviz.config import VoxelConfig
from bevviz.model.frame import F32, I32, I64
from bevviz.model.results import Voxels
from bevviz.stages.cells import cell_keys, group
from bevviz.support.kernel import kernel

S = TypeVar("S", bound=np.generic)


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
    kept, inverse = _thin(points, keys, config.average)
    return Voxels(kept, inverse)


@kernel
def _thin(points: F32, keys: I64, average: bool) -> tuple[F32, I32]:
    """One point for each unequal key, and which of them stands for each point."""
    number, first = group(keys)
    kept = np.empty((len(first), 3), np.float32)
    for k in range(len(first)):
        kept[k] = points[first[k]]
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
def of_points(values: NDArray[S], inverse: I32) -> NDArray[S]:
    """(N,) for each point what is values of its voxel."""
    found = np.empty(len(inverse), values.dtype)
    for i in range(len(inverse)):
        found[i] = values[inverse[i]]
    return found
