"""Outlines of boxes in space, in an image and in the bird's-eye view."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from bevviz.config import BevConfig
from bevviz.model import geometry
from bevviz.model.frame import F32, F64, I64, Boxes3D, Camera
from bevviz.stages.visibility import image_points

_EDGES = [0, 1, 2, 3, 0, 4, 5, 1, 5, 6, 2, 6, 7, 3, 7, 4]


def edges(corners: F32) -> F32:
    """Return one stroke along all edges of each box or frustum: (..., 16, D) for (..., 8, D) corners."""
    return corners[..., _EDGES, :]


def image_outlines(boxes: Boxes3D, camera: Camera) -> list[F32]:
    """Return the outline of each of (K,) boxes around the robot in an image: one stroke of (M, 2) pixels.

    The stroke follows all edges of a box that is completely in the image. Otherwise it is the contour of the
    box, cut at the image border. It is empty for a box outside of the image.
    """
    empty = np.zeros((0, 2), np.float32)
    if camera.intrinsics is None or (projected := image_points(boxes, camera)) is None:
        return [empty] * len(boxes)
    width, height = camera.intrinsics.width - 0.5, camera.intrinsics.height - 0.5
    image = np.array([(-0.5, -0.5), (width, -0.5), (width, height), (-0.5, height)], np.float32)
    with np.errstate(invalid="ignore"):
        inside = (projected >= image[0]) & (projected < image[2])
    is_whole: list[bool] = inside[:, :8].all(axis=(1, 2)).tolist()
    outlines = []
    for points, whole in zip(projected, is_whole, strict=True):
        if whole:
            outlines.append(edges(points[:8]))
            continue
        area, cut, visible = 0.0, empty, points[np.isfinite(points[:, 0]) & np.isfinite(points[:, 1])]
        if len(visible):
            area, cut = cv2.intersectConvexConvex(cv2.convexHull(visible), image)
        outlines.append(np.concatenate([cut[:, 0], cut[:1, 0]]) if area > 0 else empty)
    return outlines


def bev_pixels(config: BevConfig, points_from_frame: F64, positions: F32) -> F32:
    """Project (..., 3) positions to (..., 2) pixels of the bird's-eye image."""
    reach = np.array([config.range_x, config.range_y], np.float32)
    xy = geometry.apply(points_from_frame, positions.reshape(-1, 3))[:, :2]
    pixels = ((reach - xy) / np.float32(config.resolution))[:, ::-1]
    return np.asarray(pixels, np.float32).reshape(*positions.shape[:-1], 2)


def bev_outlines(config: BevConfig, boxes: Boxes3D, points_from_boxes: F64 | None = None) -> tuple[I64, F32]:
    """Return the outlines of the boxes with their centre in the bird's-eye view.

    Args:
        config: size of the view.
        boxes: (K,) boxes.
        points_from_boxes: (4, 4) transform into the frame of the points; None: the boxes are in it.

    Returns:
        (N,) rows of these boxes, and (N, 5, 2) pixels of their closed outlines.
    """
    points_from_boxes = np.eye(4) if points_from_boxes is None else points_from_boxes
    reach = np.array([config.range_x, config.range_y], np.float32)
    centers = geometry.apply(points_from_boxes, boxes.center)[:, :2]
    rows: I64 = np.flatnonzero((np.abs(centers) < reach).all(axis=1))
    rims = ground_outlines(geometry.corners(boxes)[rows])
    return rows, bev_pixels(config, points_from_boxes, rims)


def bounds_of(strokes: Sequence[F32]) -> F32:
    """Return (K, 4) bounds of outlines of (M, 2) pixels: left, top, right, bottom."""
    bounds = [[*stroke.min(axis=0), *stroke.max(axis=0)] for stroke in strokes]
    return np.array(bounds, np.float32).reshape(-1, 4)


def ground_outlines(corners: F32) -> F32:
    """Return (K, 5, 3) closed outlines on the ground for (K, 8, 3) box corners."""
    return corners[:, [0, 1, 2, 3, 0]]
