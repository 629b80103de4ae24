"""Log the bird's-eye view: image, channels, and the occupancy grid on the ground."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import rerun as rr

from bevviz.config import BevConfig, Config
from bevviz.model import geometry
from bevviz.model.frame import F32, F64
from bevviz.model.results import Bev, FrameResult
from bevviz.recording import entities, retention
from bevviz.recording.primitives import blob, jpeg, png
from bevviz.recording.writer import Writer

_GRID_ROTATION = np.array(
    [0.0, 0.0, -np.sqrt(0.5), np.sqrt(0.5)]
)  # rotation by -90 degrees about z, as x, y, z, w


def log_bev(to: Writer, bev: Bev, config: Config) -> None:
    """Log the bird's-eye image and its channels.

    The reference style is logged as PNG, so that pixels equal those of the tutorial. The others are JPEG.
    """
    quality = config.logging.jpeg_quality if retention.keeps_everything(config) else retention.BEV_QUALITY
    is_reference = config.bev.style == "reference"
    to.put(entities.BEV, png(bev.image) if is_reference else jpeg(bev.image, quality))
    for name, grid in bev.channels.items():
        if name != "occupancy":
            to.put(entities.channel(name), rr.Image(grid, color_model="L"))


def log_grid(to: Writer, result: FrameResult, bev: Bev) -> None:
    """Log the occupancy grid on the ground. The pose of a grid map is the pose of its lower left corner.

    The pose is part of the grid map, not a separate transform. The viewer keeps the transforms of the whole
    drive, and a chunk stays in memory as a whole. A transform in the chunk would keep every grid in memory.
    """
    grid = bev.channels.get("occupancy")
    if grid is None:
        return
    level = 0.0
    if result.ground is not None and result.voxels is not None:
        heights = result.voxels.points[::32, 2].compress(result.ground.mask[::32])
        level = float(np.median(heights)) if len(heights) else 0.0
    corner = np.array([-bev.range_x, bev.range_y, level - 0.05])
    pose = result.frame.pose @ geometry.transform(corner, _GRID_ROTATION)
    to.put(
        entities.GRID,
        _grid_style(*grid.shape, bev.resolution),
        rr.GridMap.from_fields(
            data=blob(grid.view(np.uint8).ravel()),
            translation=pose[:3, 3],
            quaternion=rr.Quaternion(xyzw=geometry.quaternion(pose)),
        ),
    )


@lru_cache(maxsize=2)
def _grid_style(rows: int, columns: int, resolution: float) -> rr.GridMap:
    return rr.GridMap.from_fields(
        format=rr.components.ImageFormat(width=columns, height=rows, color_model="L", channel_datatype="U8"),
        cell_size=resolution,
        opacity=0.2,
        colormap=rr.components.Colormap.RvizMap,
    )


def bev_pixels(config: BevConfig, points_from_frame: F64, positions: F32) -> F32:
    """Project (..., 3) positions to (..., 2) pixels of the bird's-eye image."""
    reach = np.array([config.range_x, config.range_y], np.float32)
    xy = geometry.apply(points_from_frame, positions.reshape(-1, 3))[:, :2]
    pixels = ((reach - xy) / np.float32(config.resolution))[:, ::-1]
    return np.asarray(pixels, np.float32).reshape(*positions.shape[:-1], 2)


def ground_outlines(corners: F32) -> F32:
    """Return (K, 5, 3) closed outlines on the ground for (K, 8, 3) box corners."""
    return corners[:, [0, 1, 2, 3, 0]]
