"""Instance masks from prototypes of the whole image, weighted for each object and cropped to its box."""

from __future__ import annotations

import cv2
import numpy as np

from bevviz.model.frame import F32, I64
from bevviz.model.results import Masks
from bevviz.stages.detector.image import Placement


def masks(coefficients: F32, prototypes: F32, xyxy: F32, rows: I64, count: int, where: Placement) -> Masks:
    """Compute masks as YOLACT does (Bolya et al. 2019), in the order of operations of Ultralytics 8.4.

    The weighted sum of the prototypes, enlarged to the network's input, is above 0 on the object.

    Args:
        coefficients: (K, C) weights.
        prototypes: (C, h, w), of the whole input.
        xyxy: (K, 4) boxes in pixels of the input.
        rows: (K,) detections that the masks belong to.
        count: number of all detections.
        where: placement of the image in the input.
    """
    (height, width), (channels, low, across) = where.input_size, prototypes.shape
    logits = (coefficients.astype(np.float32) @ prototypes.astype(np.float32).reshape(channels, -1)).reshape(
        -1, low, across
    )
    # A cell is in the box if its left upper corner is.
    edges = np.ceil(np.clip(xyxy, 0, np.array([width, height] * 2, np.float32))).astype(int)
    place, cells = np.zeros((count, 4), np.int32), [np.zeros(0, bool)] * count
    for values, (x0, y0, x1, y1), row in zip(logits, edges.tolist(), rows.tolist(), strict=True):
        mask = _enlarged(values, (height, width), x0, y0, x1, y1) > 0
        if mask.any():
            place[row] = x0, y0, x1 - x0, y1 - y0
            cells[row] = mask.ravel()
    scale = [inner / image for inner, image in zip(where.inner[::-1], where.image_size[::-1], strict=True)]
    grid = np.array([*scale, *where.corner[::-1]], np.float32)
    return Masks(np.packbits(np.concatenate([*cells, np.zeros(0, bool)])), place, grid)


def _enlarged(values: F32, size: tuple[int, int], x0: int, y0: int, x1: int, y1: int) -> F32:
    """Return a crop of an image enlarged to ``size``. Only the part that the crop needs is enlarged."""
    if x1 <= x0 or y1 <= y0:
        return np.zeros((0, 0), np.float32)
    fy, fx = size[0] // values.shape[0], size[1] // values.shape[1]
    left, top = max(x0 // fx - 1, 0), max(y0 // fy - 1, 0)
    part = values[top : -(-y1 // fy) + 1, left : -(-x1 // fx) + 1]
    large = cv2.resize(part, (part.shape[1] * fx, part.shape[0] * fy), interpolation=cv2.INTER_LINEAR)
    crop: F32 = large[y0 - top * fy : y1 - top * fy, x0 - left * fx : x1 - left * fx]
    return crop
