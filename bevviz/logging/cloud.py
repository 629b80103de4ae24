"""The points: as they came, and voxelised as ground and obstacles."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from bevviz.frame import F32, Frame, FrameResult
from bevviz.logging import entities
from bevviz.logging.entities import ClassId
from bevviz.logging.pieces import rounded, transform
from bevviz.logging.writer import Writer
from bevviz.stages.voxel import of_points


def log_cloud_looks(to: Writer, lidars: Iterable[str]) -> None:
    for lidar in lidars:
        to.static(entities.points(lidar), rr.Points3D.from_fields(radii=rr.Radius.ui_points(1.0)))
        for path in (entities.ground(lidar), entities.obstacles(lidar)):
            to.static(path, rr.Points3D.from_fields(radii=rr.Radius.ui_points(1.5)))


def log_cloud(to: Writer, result: FrameResult) -> None:
    """Every raw point, exact, of several LiDARs each in its own frame."""
    frame = result.frame
    class_ids = np.zeros(len(frame.points), np.uint16)
    if result.voxels is not None and result.ground is not None:
        of_voxels = np.where(result.ground.mask, ClassId.GROUND, ClassId.OBSTACLE).astype(np.uint16)
        class_ids = of_points(of_voxels, result.voxels.inverse)
    if len(frame.clouds) > 1:
        _log_merged(to, frame, class_ids)
    elif len(frame.points):
        to.put(entities.points(frame.lidar), rr.Points3D(frame.points, class_ids=class_ids))


def _log_merged(to: Writer, frame: Frame, class_ids: NDArray[np.uint16]) -> None:
    end = 0
    for cloud, points_from_cloud in zip(frame.clouds, frame.points_from_clouds, strict=True):
        start, end = end, end + len(cloud.xyz)
        to.put(entities.sensor(cloud.name), transform(frame.pose @ points_from_cloud))
        if len(cloud.xyz):
            to.put(entities.points(cloud.name), rr.Points3D(cloud.xyz, class_ids=class_ids[start:end]))


def log_ground(to: Writer, result: FrameResult, voxel_size: float) -> None:
    if result.voxels is None or result.ground is None:
        return
    ground = quantised(result.voxels.points.compress(result.ground.mask, axis=0), voxel_size)
    _log_class(to, entities.ground(result.frame.lidar), ground, ClassId.GROUND)


def log_obstacles(to: Writer, frame: Frame, obstacles: F32) -> None:
    """``obstacles`` as of ``quantised``."""
    _log_class(to, entities.obstacles(frame.lidar), obstacles, ClassId.OBSTACLE)


def _log_class(to: Writer, path: str, points: F32, class_id: ClassId) -> None:
    if len(points):
        to.put(path, rr.Points3D(points, class_ids=class_id))


def quantised(points: F32, voxel_size: float) -> F32:
    """Voxelised points, rounded, which compresses to half; with size 0 as they are.

    The step is a power of two of a metre, from an eighth to a quarter of a voxel: no coordinate moves by more
    than an eighth of one.
    """
    if voxel_size == 0:
        return points
    return rounded(points, 2.0 ** np.floor(np.log2(8 / voxel_size)))
