"""Visibility of boxes: their extent in a camera's image, and their occlusion by nearer points."""

from __future__ import annotations

import numpy as np

from bevviz.model import geometry
from bevviz.model.frame import F32, F64, Boxes3D, Camera
from bevviz.support.numba_kernel import kernel

CELL_ANGLE = np.float32(np.radians(0.8))  # radians: edge of a cell of the range image
OCCLUSION_MARGIN = np.float32(0.7)  # metres: a return hides a box if it is at least this much nearer
MIN_ELEVATION, MAX_ELEVATION = np.float32(np.radians(-40)), np.float32(np.radians(20))
NEAR_PLANE = 0.1  # metres before the camera; only the part of a box beyond it is drawn

_EDGES = np.array(
    [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
)

# --- in an image -------------------------------------------------------------------------------


def image_boxes(boxes: Boxes3D, camera: Camera) -> F32:
    """Return (K, 4) image boxes around the part of each 3D box before the camera, clipped to the image.

    A row is NaN if no part of the box is in the image.

    Args:
        boxes: in the frame of the points.
        camera: without intrinsics and pose every row is NaN.
    """
    visible_boxes = np.full((len(boxes), 4), np.nan, np.float32)
    if camera.intrinsics is None or (uv := image_points(boxes, camera)) is None:
        return visible_boxes
    known = np.isfinite(uv[..., 0]) & np.isfinite(uv[..., 1])
    low = np.where(known[..., None], uv, np.inf).min(axis=1)
    high = np.where(known[..., None], uv, -np.inf).max(axis=1)
    limit = np.array([camera.intrinsics.width, camera.intrinsics.height], np.float32) - 0.5
    low, high = np.clip(low, -0.5, limit), np.clip(high, -0.5, limit)
    is_visible = known.any(axis=1) & (high > low).all(axis=1)
    visible_boxes[is_visible] = np.hstack([low, high])[is_visible]
    return visible_boxes


def image_points(boxes: Boxes3D, camera: Camera) -> F32 | None:
    """Return (K, 20, 2) pixels of each box: its 8 corners, and where its 12 edges meet the near plane.

    A pixel is NaN if the corner is not before the camera or the edge does not meet the plane. The result is
    None if there are no boxes or the camera has no intrinsics or no pose.
    """
    if camera.intrinsics is None or camera.camera_from_points is None or not len(boxes):
        return None
    corners = geometry.apply(camera.camera_from_points, geometry.corners(boxes).reshape(-1, 3))
    corners = corners.reshape(-1, 8, 3).astype(np.float64)
    a, b = corners[:, _EDGES[:, 0]], corners[:, _EDGES[:, 1]]
    cut = (a[..., 2] < NEAR_PLANE) != (b[..., 2] < NEAR_PLANE)
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = a + (b - a) * ((NEAR_PLANE - a[..., 2]) / (b[..., 2] - a[..., 2]))[..., None]
    points = np.concatenate([corners, crossing], axis=1)
    points[~np.concatenate([corners[..., 2] >= NEAR_PLANE, cut], axis=1)] = np.nan
    uv, _ = geometry.project(points.reshape(-1, 3), camera.intrinsics)
    return uv.reshape(len(boxes), -1, 2)


def share_in_image(boxes: Boxes3D, camera: Camera) -> F64:
    """Return the (K,) share of each box inside the image; 0 if the camera's pose is not known."""
    if camera.intrinsics is None or camera.camera_from_points is None or len(boxes) == 0:
        return np.zeros(len(boxes))
    steps = np.linspace(-0.45, 0.45, 5, dtype=np.float32)
    grid = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3)
    local = grid[None] * boxes.size[:, None]
    c, s = np.cos(boxes.yaw)[:, None], np.sin(boxes.yaw)[:, None]
    x, y = c * local[..., 0] - s * local[..., 1], s * local[..., 0] + c * local[..., 1]
    points = np.stack([x, y, local[..., 2]], axis=-1) + boxes.center[:, None]
    uv, _ = geometry.project(
        geometry.apply(camera.camera_from_points, points.reshape(-1, 3)), camera.intrinsics
    )
    limit = np.array([camera.intrinsics.width, camera.intrinsics.height], np.float32) - 0.5
    with np.errstate(invalid="ignore"):
        inside = ((uv >= -0.5) & (uv < limit)).all(axis=1)
    return np.asarray(inside.reshape(len(boxes), -1).mean(axis=1), np.float64)


# --- behind something --------------------------------------------------------------------------


def range_image(points: F32) -> F32:
    """Return (rows, columns) metres to the nearest return in each direction, inf without a return.

    Args:
        points: (N, 3) from the sensor, z up. Rows go up from 40 degrees below the horizon. Columns go around,
            starting behind the sensor.
    """
    x, y, z, flat, away = _distances(points)
    # This is outside the loops, because NumPy's vectorised arctan2 is four times as fast.
    elevation, azimuth = np.arctan2(z, flat), np.arctan2(y, x)
    shape = round(float((MAX_ELEVATION - MIN_ELEVATION) / CELL_ANGLE)), round(2 * np.pi / float(CELL_ANGLE))
    image = np.full(shape, np.inf, np.float32)
    _keep_nearest(image, elevation, azimuth, away)
    return image


def visible(image: F32, boxes: Boxes3D) -> F32:
    """Return the (K,) unoccluded share of each box: directions without a return nearer than the whole box.

    A cell of the image is a direction to the box if its centre is inside the box's angles. A cell that only
    touches the lower edge of the box shows the ground before it.

    Args:
        image: from ``range_image``.
        boxes: in the frame of the points of ``range_image``. A box that contains the sensor is fully visible.
    """
    if len(boxes) == 0:
        return np.zeros(0, np.float32)
    corners = geometry.corners(boxes)
    flat = np.hypot(corners[..., 0], corners[..., 1])
    middle = np.arctan2(boxes.center[:, 1], boxes.center[:, 0])
    azimuth = np.arctan2(corners[..., 1], corners[..., 0]) - middle[:, None]
    azimuth = np.arctan2(np.sin(azimuth), np.cos(azimuth))
    elevation = np.arctan2(corners[..., 2], np.maximum(flat, 1e-3))
    c, s = np.cos(boxes.yaw), np.sin(boxes.yaw)
    x, y, z = boxes.center.T
    local = np.column_stack([c * x + s * y, c * y - s * x, z])
    near = np.linalg.norm(np.maximum(np.abs(local) - boxes.size / 2, 0), axis=1)
    return _visible_share(
        image,
        np.column_stack([middle + azimuth.min(1), middle + azimuth.max(1)]).astype(np.float32),
        np.column_stack([elevation.min(1), elevation.max(1)]).astype(np.float32),
        near.astype(np.float32),
    )


@kernel
def _distances(points: F32) -> F32:
    """Return (5, N) x, y and z of each point, its horizontal distance and its distance."""
    columns = np.empty((5, len(points)), np.float32)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        flat = np.sqrt(x * x + y * y)
        columns[0, i], columns[1, i], columns[2, i] = x, y, z
        columns[3, i], columns[4, i] = flat, np.sqrt(flat * flat + z * z)
    return columns


@kernel
def _keep_nearest(image: F32, elevation: F32, azimuth: F32, away: F32) -> None:
    """Write the nearest distance of each cell."""
    rows, columns = image.shape
    for i in range(len(away)):
        row = int(np.floor((elevation[i] - MIN_ELEVATION) / CELL_ANGLE))
        if 0 <= row < rows:
            column = int(np.floor((azimuth[i] + np.pi) / CELL_ANGLE))
            if column >= columns:  # A remainder would take most of the time.
                column -= columns
            elif column < 0:
                column += columns
            if away[i] < image[row, column]:
                image[row, column] = away[i]


@kernel
def _visible_share(image: F32, azimuth: F32, elevation: F32, near: F32) -> F32:
    """Return the (K,) share of cells between the angles without a return nearer than ``near``."""
    rows, columns = image.shape
    share = np.ones(len(near), np.float32)
    for k in range(len(near)):
        if azimuth[k, 1] - azimuth[k, 0] > np.pi:
            continue
        first, last = _cells((azimuth[k, 0] + np.pi) / CELL_ANGLE, (azimuth[k, 1] + np.pi) / CELL_ANGLE)
        low, high = _cells(
            (elevation[k, 0] - MIN_ELEVATION) / CELL_ANGLE, (elevation[k, 1] - MIN_ELEVATION) / CELL_ANGLE
        )
        total, hidden = 0, 0
        for row in range(max(low, 0), min(high, rows)):
            for column in range(first, last):
                total += 1
                hidden += image[row, column % columns] < near[k] - OCCLUSION_MARGIN
        if total:
            share[k] = np.float32(1 - hidden / total)
    return share


@kernel
def _cells(low: float, high: float) -> tuple[int, int]:
    """Return the first and the end of the cells whose centre is between ``low`` and ``high``.

    If there is none, return the cell that holds the middle of the interval.
    """
    first, end = int(np.ceil(low - 0.5)), int(np.floor(high - 0.5)) + 1
    if end <= first:
        first = int(np.floor((low + high) / 2))
        end = first + 1
    return first, end
