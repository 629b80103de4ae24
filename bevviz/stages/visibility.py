"""Which boxes are hidden behind something nearer: asked of the range image of the scan."""

from __future__ import annotations

import numpy as np

from bevviz import geometry
from bevviz.frame import F32, Boxes3D
from bevviz.stages.kernel import kernel

STEP = np.float32(np.radians(0.8))  # radians: edge of a cell of the range image
NEARER = np.float32(0.7)  # metres that a return must be nearer than the box to hide it
BELOW, ABOVE = np.float32(np.radians(-40)), np.float32(np.radians(20))


def range_image(points: F32) -> F32:
    """(rows, columns) metres to the nearest return in each direction, inf where there is none.

    Args:
        points: (N, 3) from the sensor, z up. Rows go up from 40 degrees below, columns around from behind.
    """
    x, y, z = np.ascontiguousarray(points.T)
    flat = np.sqrt(x * x + y * y)
    away = np.sqrt(flat * flat + z * z)
    # Not in the loop: NumPy has arctan2 of many numbers at once, four times as fast.
    elevation, azimuth = np.arctan2(z, flat), np.arctan2(y, x)
    shape = round(float((ABOVE - BELOW) / STEP)), round(2 * np.pi / float(STEP))
    image = np.full(shape, np.inf, np.float32)
    _keep_nearest(image, elevation, azimuth, away)
    return image


def visible(image: F32, boxes: Boxes3D) -> F32:
    """(K,) share of the directions to each box in which nothing nearer stands.

    Args:
        image: of ``range_image``.
        boxes: in the frame of its points. One that holds the sensor is seen whole.
    """
    if len(boxes) == 0:
        return np.zeros(0, np.float32)
    corners = geometry.corners(boxes)
    flat = np.hypot(corners[..., 0], corners[..., 1])
    middle = np.arctan2(boxes.center[:, 1], boxes.center[:, 0])
    azimuth = np.arctan2(corners[..., 1], corners[..., 0]) - middle[:, None]
    azimuth = np.arctan2(np.sin(azimuth), np.cos(azimuth))
    elevation = np.arctan2(corners[..., 2], np.maximum(flat, 1e-3))
    near = np.maximum(np.linalg.norm(boxes.center, axis=1) - np.linalg.norm(boxes.size, axis=1) / 2, 0.0)
    return _open(
        image,
        np.column_stack([middle + azimuth.min(1), middle + azimuth.max(1)]).astype(np.float32),
        np.column_stack([elevation.min(1), elevation.max(1)]).astype(np.float32),
        near.astype(np.float32),
    )


@kernel
def _keep_nearest(image: F32, elevation: F32, azimuth: F32, away: F32) -> None:
    rows, columns = image.shape
    for i in range(len(away)):
        row = int(np.floor((elevation[i] - BELOW) / STEP))
        if 0 <= row < rows:
            column = int(np.floor((azimuth[i] + np.pi) / STEP)) % columns
            if away[i] < image[row, column]:
                image[row, column] = away[i]


@kernel
def _open(image: F32, azimuth: F32, elevation: F32, near: F32) -> F32:
    rows, columns = image.shape
    found = np.ones(len(near), np.float32)
    for k in range(len(near)):
        if azimuth[k, 1] - azimuth[k, 0] > np.pi:
            continue
        first = int(np.floor((azimuth[k, 0] + np.pi) / STEP))
        last = int(np.floor((azimuth[k, 1] + np.pi) / STEP))
        low = max(int(np.floor((elevation[k, 0] - BELOW) / STEP)), 0)
        high = min(int(np.floor((elevation[k, 1] - BELOW) / STEP)), rows - 1)
        all_of, hidden = 0, 0
        for row in range(low, high + 1):
            for column in range(first, last + 1):
                all_of += 1
                hidden += image[row, column % columns] < near[k] - NEARER
        if all_of:
            found[k] = np.float32(1 - hidden / all_of)
    return found
