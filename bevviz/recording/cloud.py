"""Log point clouds: raw points, and voxels of ground and obstacles."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from bevviz.config.sections import Quantity
from bevviz.model.frame import F32, Frame
from bevviz.model.results import FrameResult
from bevviz.recording import color_by, entities, retention
from bevviz.recording.entities import ClassId
from bevviz.recording.primitives import rounded, transform
from bevviz.recording.writer import Writer
from bevviz.stages.voxel import spread_to_points

RawCloud: TypeAlias = tuple[str, F32, NDArray[np.uint16]]  # entity, points, class id of each point


def log_cloud_style(to: Writer, lidars: Iterable[str]) -> None:
    """Log the static style of the points of each LiDAR."""
    for lidar in lidars:
        radii = rr.Points3D.from_fields(radii=rr.Radius.ui_points(1.0))
        to.static(entities.points(lidar), radii, color_by.annotation_context())
        for path in (entities.ground(lidar), entities.obstacles(lidar)):
            to.static(path, rr.Points3D.from_fields(radii=rr.Radius.ui_points(1.5)))


def log_cloud(to: Writer, result: FrameResult, quantities: Sequence[Quantity]) -> None:
    """Log every raw point without loss, with the quantities that can colour it.

    With several LiDARs, each cloud is logged in its own frame.
    """
    frame = result.frame
    log_cloud_poses(to, frame)
    heights = color_by.height_ids(result) if "height" in quantities else np.zeros(len(frame.points), np.uint8)
    fields = {entities.points(cloud.name): cloud.fields for cloud in frame.clouds}
    start = 0
    for path, points, class_ids in raw_clouds(result):
        end = start + len(points)
        cloud_fields = fields[path] if len(frame.clouds) > 1 else frame.fields
        ids_by_quantity = color_by.class_ids(quantities, points, heights[start:end], cloud_fields)
        to.put(path, color_by.ColoredPoints(rr.Points3D(points, class_ids=class_ids), ids_by_quantity))
        start = end


def log_cloud_poses(to: Writer, frame: Frame) -> None:
    """Log the pose of each LiDAR if there are several."""
    if len(frame.clouds) > 1:
        for cloud, points_from_cloud in zip(frame.clouds, frame.points_from_clouds, strict=True):
            to.put(entities.sensor(cloud.name), transform(frame.pose @ points_from_cloud))


def raw_clouds(result: FrameResult) -> list[RawCloud]:
    """Return the raw clouds that have points."""
    frame = result.frame
    class_ids = np.zeros(len(frame.points), np.uint16)
    if result.voxels is not None and result.ground is not None:
        voxel_ids = np.where(result.ground.mask, ClassId.GROUND, ClassId.OBSTACLE).astype(np.uint16)
        class_ids = spread_to_points(voxel_ids, result.voxels.inverse)
    if len(frame.clouds) <= 1:
        return [(entities.points(frame.lidar), frame.points, class_ids)] if len(frame.points) else []
    clouds, end = [], 0
    for cloud in frame.clouds:
        start, end = end, end + len(cloud.xyz)
        if len(cloud.xyz):
            clouds.append((entities.points(cloud.name), cloud.xyz, class_ids[start:end]))
    return clouds


def log_ground(to: Writer, result: FrameResult, voxel_size: float, *, packed: bool = False) -> None:
    """Log the ground voxels.

    Args:
        to: writer of the recording.
        result: results of the frame.
        voxel_size: metres.
        packed: round and sort the points, as in recordings that do not keep everything.
    """
    if result.voxels is None or result.ground is None:
        return
    ground = result.voxels.points.compress(result.ground.mask, axis=0)
    if packed:
        scale = retention.rounding_scale(voxel_size, retention.OTHER_STEPS)
        ground = round_points(ground.take(retention.sorted_rows(ground, scale), axis=0), scale)
    else:
        ground = round_voxels(ground, voxel_size)
    _log_class(to, entities.ground(result.frame.lidar), ground, ClassId.GROUND)


def log_obstacles(to: Writer, frame: Frame, obstacles: F32) -> None:
    """Log the obstacle points. ``round_voxels`` has rounded them."""
    _log_class(to, entities.obstacles(frame.lidar), obstacles, ClassId.OBSTACLE)


def _log_class(to: Writer, path: str, points: F32, class_id: ClassId) -> None:
    if len(points):
        to.put(path, rr.Points3D(points, class_ids=class_id))


def round_voxels(points: F32, voxel_size: float) -> F32:
    """Round voxel points, which halves their compressed size. With a voxel size of 0, return them unchanged.

    The step is a power of two of a metre, from an eighth to a quarter of a voxel. No coordinate moves by more
    than an eighth of a voxel.
    """
    if voxel_size == 0:
        return points
    return rounded(points, 2.0 ** np.floor(np.log2(8 / voxel_size)))


def round_points(points: F32, scale: float) -> F32:
    """Round points to the nearest 1 / scale. With a scale of 0, return them unchanged."""
    return rounded(points, scale) if scale else points
